"""Marker CSV: the layout, round trips, broken files."""

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from mutation import check_reader
from take_strategies import check_refused, marker_takes, round_trip, same

from torchface import load_take
from torchface.errors import FileFormatError
from torchface.io.markers.c3d import load_c3d, save_c3d
from torchface.io.markers.marker_csv import load_markers_csv, save_markers_csv
from torchface.io.markers.trc import load_trc, save_trc
from torchface.take import Take, Track

_GOOD = """frame,time,nose_x,nose_y,nose_z,chin_x,chin_y,chin_z
0,0.0,1.5,2,3,4,5,6
1,0.02,,,,7,8,9
2,0.04,1,2,3,4,nan,6
"""


@given(marker_takes())
@settings(max_examples=25)
def test_a_take_comes_back_to_the_bit(take: Take) -> None:
    assert round_trip(save_markers_csv, load_markers_csv, take).fps == take.fps


def test_the_layout_is_read_as_documented(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text(_GOOD.replace(",chin_x", ", chin_x"), encoding="utf-8-sig")
    take = load_markers_csv(tmp_path / "take.csv", unit="in")
    nan = torch.nan
    expected = [[[1.5, 2, 3], [4, 5, 6]], [[nan] * 3, [7, 8, 9]], [[1, 2, 3], [nan] * 3]]
    assert take.fps == 50
    assert same(take.markers.values, (torch.tensor(expected).double() * 25.4).float())


def test_columns_are_matched_by_name(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text("frame,time,a_z,b_y,a_x,b_x,a_y,b_z\n0,0,3,20,1,10,2,30\n")
    take = load_markers_csv(tmp_path / "take.csv")
    assert take.markers.names == ("a", "b")
    assert take.markers.values.tolist() == [[[1, 2, 3], [10, 20, 30]]]


def test_dropped_frames_leave_the_others_their_times_and_the_rate(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text(_GOOD.replace("2,0.04", "5,0.1"))
    take = load_markers_csv(tmp_path / "take.csv")
    assert take.fps == 50
    torch.testing.assert_close(take.seconds, torch.tensor([0, 0.02, 0.1], dtype=torch.float64), atol=1e-9, rtol=0)
    save_markers_csv(take, tmp_path / "again.csv")
    assert load_markers_csv(tmp_path / "again.csv").seconds.equal(take.seconds)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("chin_y", "chin_q", r"found the columns .*expected frame,time,<label>_x"),
        (",chin_y", "", r"found no column 'chin_y', expected it in the header"),
        ("chin_x", "nose_x", r"found more than one column 'nose_x', expected each once"),
        ("frame,time", "image,time", r"found the columns 'image'"),
        ("1.5", "one", r"row 2, column 'nose_x': found 'one', expected a number"),
        ("1.5", "1_5", r"row 2, column 'nose_x': found '1_5', expected a number"),
        ("1.5", "-inf", r"row 2, column 'nose_x': found '-inf', expected a number"),
        (",7,8,9", ",7,8", r"row 3: found 7 cells, expected 8"),
        ("1,0.02", "1,0", r"found time 0 after 0 in frame 2, expected rising"),
        ("1,0.02", ",0.02", r"frame 2: found no frame number or no time"),
        ("2,0.04", "2,0.00004", r"found time .* expected rising|found 50000.0 frames a second"),
        ("\n0,0.0,1.5,2,3,4,5,6\n1,0.02,,,,7,8,9\n2,0.04,1,2,3,4,nan,6", "", r"found a header and no rows"),
    ],
)
def test_a_broken_file_is_refused_by_name(old: str, new: str, message: str, tmp_path: Path) -> None:
    check_refused(load_markers_csv, tmp_path / "broken.csv", _GOOD, (old, new), message)


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / "broken.csv").write_bytes(b"frame,time,\xff\xfe_x\n")
    with pytest.raises(FileFormatError, match=r"broken\.csv: found bytes that are no UTF-8"):
        load_markers_csv(tmp_path / "broken.csv")
    (tmp_path / "broken.csv").write_bytes(b"")
    with pytest.raises(FileFormatError, match=r"broken\.csv: found an empty file"):
        load_markers_csv(tmp_path / "broken.csv")


def test_a_mutated_marker_csv_is_read_or_refused(tmp_path: Path) -> None:
    (tmp_path / "good.csv").write_text(_GOOD)
    check_reader(load_markers_csv, [tmp_path / "good.csv"], ".csv")


@pytest.mark.parametrize("axes", ["_x _y _z", ".x .y .z", ":X :Y :Z", "-x -y -z", " X  Y  Z", "X Y Z", "_X _Y _Z"])
def test_other_separators_and_capitals_are_markers_too(axes: str, tmp_path: Path) -> None:
    ends = [" X", " Y", " Z"] if axes.startswith(" ") else axes.split()
    labels = [f"M{i:03d}" for i in range(106)]
    header = ["frame", "time", *(label + end for label in labels for end in ends)]
    values = torch.randn(4, 106, 3, generator=torch.Generator().manual_seed(0)) * 60
    rows = [[str(n), repr(n / 60), *(repr(v) for v in row.flatten().tolist())] for n, row in enumerate(values)]
    (tmp_path / "take.csv").write_text("\n".join(",".join(row) for row in [header, *rows]) + "\n")
    take = load_take(tmp_path / "take.csv")
    assert take.weights is None
    assert take.markers.names == tuple(labels)
    torch.testing.assert_close(take.markers.values, values)


def test_markers_without_one_axis_are_refused_and_no_weights(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text("frame,time,M000:X,M000:Y,M001:X,M001:Y\n0,0,1,2,3,4\n")
    with pytest.raises(FileFormatError, match=r"found no column 'M000_z', 'M001_z', expected it in the header"):
        load_take(tmp_path / "take.csv")


def test_shapes_that_end_in_an_axis_are_weights(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text("frame,time,lookX,lookY,jaw\n0,0,0.5,0.5,0.1\n1,0.1,0.5,0.5,0.1\n")
    take = load_take(tmp_path / "take.csv")
    assert take.weights.names == ("lookX", "lookY", "jaw")


def test_micrometres_are_read_where_they_are_asked_for(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text("frame,time,a_x,a_y,a_z\n0,0,1000,2500,-500\n")
    take = load_take(tmp_path / "take.csv", unit="um")
    assert take.markers.values.flatten().tolist() == [1, 2.5, -0.5]
    assert take.extras["unit"] == "um"


def test_the_origin_stands_for_not_seen(tmp_path: Path) -> None:
    table = tmp_path / "take.csv"
    table.write_text("frame,time,a_x,a_y,a_z,b_x,b_y,b_z\n0,0,0,0,0,0,5,0\n1,0.02,0,-0,0.0,1,2,3\n2,0.04,1,0,0,1,2,3\n")
    markers = load_markers_csv(table).markers
    assert torch.isnan(markers.values).any(2).tolist() == [[True, False], [True, False], [False, False]]
    # The other formats end in the same function.
    for name, save, load in (("take.c3d", save_c3d, load_c3d), ("take.trc", save_trc, load_trc)):
        values = torch.tensor([[[0.0, 0, 0], [0, 5, 0]], [[1, 0, 0], [0, 0, 0]]])
        save(Take(60.0, markers=Track(("a", "b"), values)), tmp_path / name)
        found = load(tmp_path / name).markers
        assert torch.isnan(found.values).any(2).tolist() == [[True, False], [False, True]]
        save(Take(60.0, markers=Track(("a", "b"), torch.zeros(2, 2, 3))), tmp_path / name)
        with pytest.raises(FileFormatError, match=r"none of them seen .* other than \(0, 0, 0\)"):
            load(tmp_path / name)
