"""TRC: round trips, a file as OpenSim writes it, broken files."""

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from mutation import check_reader
from take_strategies import check_refused, marker_takes, round_trip, same

from torchface.errors import FileFormatError
from torchface.io.markers.trc import load_trc, save_trc
from torchface.take import Take, Track

_OPENSIM = """PathFileType\t4\t(X/Y/Z)\tsubject01.trc\t
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames
59.94\t59.94\t3\t2\tcm\t59.94\t1\t3
Frame#\tTime\tnose\t\t\tchin\t\t
\t\tX1\tY1\tZ1\tX2\tY2\tZ2\t

1\t0.00000\t1.5\t-2\t3e1\t4\t5\t6\t
2\t0.01668\t1\t2\t3\t\t\t\t
3\t0.03337\tNaN\tNaN\tNaN\t7\t8\t9\t
"""


@given(marker_takes())
@settings(max_examples=25)
def test_a_take_comes_back_to_the_bit(take: Take) -> None:
    assert round_trip(save_trc, load_trc, take).fps == take.fps


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_a_file_as_opensim_writes_it_is_read(line_end: str, tmp_path: Path) -> None:
    (tmp_path / "take.trc").write_bytes(_OPENSIM.replace("\n", line_end).encode())
    take = load_trc(tmp_path / "take.trc")
    assert take.markers.names == ("nose", "chin")
    assert take.fps == 59.94
    nan = torch.nan
    expected = [[[15, -20, 300], [40, 50, 60]], [[10, 20, 30], [nan] * 3], [[nan] * 3, [70, 80, 90]]]
    assert same(take.markers.values, torch.tensor(expected))
    metres = load_trc(tmp_path / "take.trc", unit="m")
    assert metres.markers.values[0, 1].tolist() == [4000, 5000, 6000]


def test_times_of_another_rate_than_the_header_says_count_and_are_named(tmp_path: Path) -> None:
    (tmp_path / "take.trc").write_text(_OPENSIM.replace("59.94\t59.94\t3\t2", "120\t59.94\t3\t2"))
    with pytest.warns(UserWarning, match=r"found DataRate 120 and times of 59\.94\d* frames a second"):
        assert load_trc(tmp_path / "take.trc").fps == pytest.approx(59.94, abs=0.01)


def test_dropped_frames_leave_the_others_their_times_and_numbers(tmp_path: Path) -> None:
    (tmp_path / "take.trc").write_text(_OPENSIM.replace("\n3\t0.03337", "\n7\t0.10010"))
    take = load_trc(tmp_path / "take.trc")
    assert take.fps == 59.94
    assert (take.times - torch.tensor([0, 1, 6]) / 59.94).abs().max() < 1e-6
    save_trc(take, tmp_path / "again.trc")
    again = load_trc(tmp_path / "again.trc")
    assert again.numbers.tolist() == [0, 1, 6]  # TRC counts from 1
    assert again.times.equal(take.times)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("PathFileType", "SomeFileType", r"found no 'PathFileType' header"),
        ("\tUnits\t", "\tYards\t", r"found no field 'Units', expected it in rows 2 and 3"),
        ("\tcm\t", "\tparsec\t", r"Units: found 'parsec', expected one of mm, cm, m, in"),
        ("59.94\t59.94\t3", "0\t59.94\t3", r"DataRate: found 0.0 frames a second"),
        ("59.94\t59.94\t3", "fast\t59.94\t3", r"DataRate: found 'fast', expected a number"),
        ("59.94\t3\t2", "59.94\t3\t9", r"found 2 labels and NumMarkers 9, expected the same"),
        ("59.94\t3\t2", "59.94\t4000000000\t2", r"found 3 rows and NumFrames 4000000000, expected the same"),
        ("\t4\t5\t6\t", "\t4\t5", r"row 7: found 7 cells, expected 8"),
        ("\t4\t5\t6\t", "\t4\tfive\t6", r"row 7, column 'Y2': found 'five', expected a number"),
        ("\t4\t5\t6\t", "\t4\t1e39\t6", r"row 7, column 'Y2': found '1e39', expected a number"),
        ("\n2\t0.01668", "\n1\t0.01668", r"found frame 1 after frame 1, expected rising"),
        ("\n2\t0.01668", "\n1.5\t0.01668", r"found frame numbers .* no whole numbers"),
    ],
)
def test_a_broken_file_is_refused_by_name(old: str, new: str, message: str, tmp_path: Path) -> None:
    check_refused(load_trc, tmp_path / "broken.trc", _OPENSIM, (old, new), message)


def test_a_file_without_a_position_is_refused(tmp_path: Path) -> None:
    save_trc(Take(60.0, markers=Track(("nose",), torch.full((2, 1, 3), torch.nan))), tmp_path / "broken.trc")
    with pytest.raises(FileFormatError, match=r"broken\.trc: found 1 points, none of them seen in any of 2 frames"):
        load_trc(tmp_path / "broken.trc")


def test_a_mutated_trc_is_read_or_refused(tmp_path: Path) -> None:
    (tmp_path / "good.trc").write_text(_OPENSIM)
    check_reader(load_trc, [tmp_path / "good.trc"], ".trc")
