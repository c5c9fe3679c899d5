"""Live Link Face CSV: real takes byte by byte, names, kept columns, dropped frames, broken files."""

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from mutation import check_reader
from take_strategies import check_refused, round_trip, same, weight_takes

from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.io.take_files import load_take, save_take
from torchface.io.weights.live_link_csv import load_live_link, save_live_link
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT
from torchface.take import Take, Track

_SPELLED = tuple(name[0].upper() + name[1:] for name in ARKIT)


def _take(frames: int = 5, fps: float = 60.0, names: tuple[str, ...] = _SPELLED) -> Take:
    values = torch.rand(frames, len(names), 1, generator=torch.Generator().manual_seed(0))
    return Take(fps, weights=Track(names, values))


def _text(tmp_path: Path, frames: int = 3) -> str:
    save_live_link(_take(frames), tmp_path / "good.csv")
    return (tmp_path / "good.csv").read_text()


def _same_take(first: Take, second: Take) -> bool:
    ours, theirs = first.extras, second.extras
    return (
        first.fps == second.fps
        and first.timecode == second.timecode
        and first.weights.names == second.weights.names
        and same(first.weights.values, second.weights.values)
        and list(ours["columns"]) == list(theirs["columns"])
        and all(
            same(column, theirs["columns"][name])
            if isinstance(column, torch.Tensor)
            else column == theirs["columns"][name]
            for name, column in ours["columns"].items()
        )
        and {**ours, "columns": None} == {**theirs, "columns": None}
    )


@pytest.mark.real
def test_real_takes_are_read_written_and_read_again_identically(performances: list[Path], tmp_path: Path) -> None:
    assert len(performances) == 6
    for path in performances[::3]:
        take = load_take(path)
        save_take(take, tmp_path / path.name)
        assert _same_take(load_take(tmp_path / path.name), take)
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()


@pytest.mark.real
def test_real_takes_hold_what_the_app_recorded(performances: list[Path]) -> None:
    for path in performances:
        take = load_take(path)
        first = path.read_text().splitlines()[1].split(",")
        assert take.weights.names == _SPELLED
        assert take.fps == 60000 / 1001
        assert take.seconds is None
        assert tuple(take.extras["columns"]) == ROTATIONS
        assert set(take.extras["blendshape_count"]) == {61}
        assert [f"{value:.10f}" for value in take.weights.values[0, :, 0].tolist()] == first[2:54]
        assert [f"{column[0].item():.10f}" for column in take.extras["columns"].values()] == first[54:]


@pytest.mark.real
def test_frames_of_a_real_take_keep_their_times_beside_dropped_ones(performances: list[Path], tmp_path: Path) -> None:
    lines = performances[0].read_text().splitlines(keepends=True)
    del lines[1 + 700 : 1 + 703], lines[1 + 50]
    (tmp_path / "take.csv").write_text("".join(lines))
    take = load_live_link(tmp_path / "take.csv")
    numbers = torch.tensor([n for n in range(len(lines) + 3) if n not in (50, 700, 701, 702)])
    torch.testing.assert_close(take.seconds, numbers.double() * 1.001 / 60, atol=1e-9, rtol=0)
    assert take.fps == 60000 / 1001
    assert len(take) == len(lines) - 1


@given(weight_takes(_SPELLED))
@settings(max_examples=20)
def test_weights_come_back_to_the_bit(take: Take) -> None:
    round_trip(save_live_link, load_live_link, take)


def test_a_take_without_timecodes_gets_a_clock(tmp_path: Path) -> None:
    save_live_link(_take(150, 60000 / 1001), tmp_path / "take.csv")
    back = load_live_link(tmp_path / "take.csv")
    assert back.fps == 60000 / 1001
    assert back.timecode[:2] == ("00:00:00:00.000", "00:00:00:01.001")
    assert all(not column.any() for column in back.extras["columns"].values())
    assert set(back.extras["blendshape_count"]) == {61}


def test_weights_by_other_names_are_mapped_and_missing_ones_are_zero(tmp_path: Path) -> None:
    names = ("browInnerUp_L", "browInnerUp_R", "eyeBlink_R", "jawOpen", "PupilDilate")
    values = torch.tensor([[0.2, 0.4, 0.5, 0.7, 0.9], [0.1, torch.nan, 0.6, 0.8, 0.9]])[..., None]
    save_live_link(Take(60.0, weights=Track(names, values)), tmp_path / "take.csv")
    weights = load_live_link(tmp_path / "take.csv").weights
    assert weights.names == _SPELLED
    picked = weights.select(["BrowInnerUp", "EyeBlinkRight", "JawOpen"]).values[..., 0]
    torch.testing.assert_close(picked, torch.tensor([[0.3, 0.5, 0.7], [torch.nan, 0.6, 0.8]]), equal_nan=True)
    others = [name for name in _SPELLED if name not in ("BrowInnerUp", "EyeBlinkRight", "JawOpen")]
    assert not weights.select(others).values.any()
    with pytest.raises(
        NameMismatchError, match=r"take\.csv: found the shapes 'grin', expected at least one of ARKit's"
    ):
        save_live_link(Take(60.0, weights=Track(("grin",), torch.zeros(1, 1, 1))), tmp_path / "take.csv")


def test_further_columns_are_kept_and_written_back(tmp_path: Path) -> None:
    lines = _text(tmp_path).splitlines()
    lines = [
        line + end
        for line, end in zip(
            lines, [",Joy,Remark", ",0.2500000000,so", ",0.5000000000,", ",-1.0000000000,7"], strict=True
        )
    ]
    (tmp_path / "take.csv").write_text("\n".join(lines) + "\n")
    take = load_live_link(tmp_path / "take.csv")
    assert take.extras["columns"]["Joy"].tolist() == [0.25, 0.5, -1.0]
    assert take.extras["columns"]["Remark"] == ("so", "", "7")
    save_live_link(take, tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "take.csv").read_bytes()


def test_columns_in_another_order_and_case_are_found(tmp_path: Path) -> None:
    rows = [line.split(",") for line in _text(tmp_path).splitlines()]
    rows[0] = [name.lower() for name in rows[0]]
    (tmp_path / "take.csv").write_text("\n".join(",".join(reversed(row)) for row in rows))
    take, good = load_live_link(tmp_path / "take.csv"), load_live_link(tmp_path / "good.csv")
    assert take.weights.names == tuple(name.lower() for name in reversed(_SPELLED))
    assert same(take.weights.values, good.weights.values.flip(1))
    save_live_link(take, tmp_path / "again.csv")
    assert _same_take(load_live_link(tmp_path / "again.csv"), take)


@pytest.mark.parametrize("commas", [0, 61])
def test_a_frame_without_a_face_is_nan(commas: int, tmp_path: Path) -> None:
    lines = _text(tmp_path).splitlines()
    lines[2] = lines[2].split(",")[0] + ",0" + "," * commas
    (tmp_path / "take.csv").write_text("\n".join(lines) + "\n")
    take = load_live_link(tmp_path / "take.csv")
    assert take.weights.values.isnan().all((1, 2)).tolist() == [False, True, False]
    save_live_link(take, tmp_path / "again.csv")
    assert _same_take(load_live_link(tmp_path / "again.csv"), take)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Timecode", "Time", r"found no column 'Timecode'"),
        ("JawOpen", "EyeBlinkLeft", r"found more than one column 'EyeBlinkLeft'"),
        ("HeadYaw", "headPitch", r"found columns .* differ in case only"),
        (
            "00:00:00:01.000,61,0.",
            "00:00:00:01.000,61,o.",
            r"row 3, column 'EyeBlinkLeft': found 'o\..*expected a number",
        ),
        ("00:00:00:01.000,61,", "00:00:00:01.000,many,", r"frame 2, column 'BlendshapeCount': found 'many'"),
        ("00:00:00:01.000,61,", "00:00:01.000,61,", r"frame 2: found the timecode '00:00:01.000', expected HH:MM"),
        ("00:00:00:01.000,61,", "00:00:00:01.000,61,0,", r"row 3: found 64 cells, expected 63"),
    ],
)
def test_a_broken_file_is_refused_by_name(old: str, new: str, message: str, tmp_path: Path) -> None:
    check_refused(load_take, tmp_path / "broken.csv", _text(tmp_path), (old, new), message)


def test_columns_that_are_missing_are_read_as_0_and_named(tmp_path: Path) -> None:
    rows = [line.split(",") for line in _text(tmp_path).splitlines()]
    whole = load_take(tmp_path / "good.csv")
    kept = [i for i, name in enumerate(rows[0]) if name not in ("JawOpen", "TongueOut")]
    fewer = tmp_path / "fewer.csv"
    fewer.write_text("\n".join(",".join(row[i] for i in kept) for row in rows))
    with pytest.warns(UserWarning, match=r"found no column 'JawOpen', 'TongueOut': those weights are read as 0"):
        found = load_take(fewer)
    there = [name for name in whole.weights.names if name not in ("JawOpen", "TongueOut")]
    assert torch.equal(found.weights.select(there).values, whole.weights.select(there).values)
    assert found.weights.names[-2:] == ("JawOpen", "TongueOut")
    assert not found.weights.values[:, -2:].any()
    few = [rows[0].index(name) for name in ("Timecode", "BlendshapeCount", "JawOpen")]
    fewer.write_text("\n".join(",".join(row[i] for i in few) for row in rows))
    with pytest.raises(FileFormatError, match=r"found no column .* expected Timecode, BlendshapeCount and ARKit's 52"):
        load_take(fewer)


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    take = _take(2)
    with pytest.raises(ValueRangeError, match=r"take\.csv: frame 1: found the timecode 'now'"):
        save_live_link(Take(60.0, weights=take.weights, timecode=("now", "then")), tmp_path / "take.csv")
    extras = {"columns": {"HeadYaw": torch.zeros(5)}}
    with pytest.raises(ShapeError, match=r"take\.csv: found the kept columns 'HeadYaw' of other lengths, expected 2"):
        save_live_link(Take(60.0, weights=take.weights, extras=extras), tmp_path / "take.csv")
    assert not (tmp_path / "take.csv").exists()


def test_a_mutated_live_link_csv_is_read_or_refused(tmp_path: Path) -> None:
    _text(tmp_path)
    check_reader(load_live_link, [tmp_path / "good.csv"], ".csv")
