"""Times that come unevenly are the same again after each file that holds a take."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from rig_samples import sheet_rig

from torchface import Take, Track, load_take, save_take
from torchface.errors import FileFormatError, ValueRangeError
from torchface.io import load_animation, save_animation, save_live_link
from torchface.io.landmarks.landmark_tables import load_landmark_table
from torchface.shape_names import ARKIT

KINDS = ("variable rate", "dropped frames", "one long gap")


def planted_seconds(kind: str, seed: int, frames: int = 90) -> torch.Tensor:
    draw = np.random.default_rng(seed)
    if kind == "variable rate":
        return torch.from_numpy(np.cumsum(draw.uniform(0.3, 2.5, frames)) / 30)
    steps = draw.choice([1, 1, 1, 2, 4], frames) if kind == "dropped frames" else np.ones(frames, int)
    steps[frames // 2] += 40 if kind == "one long gap" else 1
    return torch.from_numpy((np.cumsum(steps) - 1) / 30)


def tracks(frames: int) -> dict[str, Track]:
    generator = torch.Generator().manual_seed(0)
    return {
        "weights.csv": Track(("one", "two"), torch.rand(frames, 2, 1, generator=generator)),
        "markers.csv": Track(("a", "b"), torch.rand(frames, 2, 3, generator=generator)),
        "markers.trc": Track(("a", "b"), torch.rand(frames, 2, 3, generator=generator)),
        "landmarks.csv": Track(("0", "1"), torch.rand(frames, 2, 2, generator=generator)),
        "live_link.csv": Track(ARKIT, torch.rand(frames, 52, 1, generator=generator)),
    }


def taken(name: str, seconds: torch.Tensor, fps: float = 30.0) -> Take:
    kind = {"markers.csv": "markers", "markers.trc": "markers", "landmarks.csv": "landmarks"}.get(name, "weights")
    return Take(fps, **{kind: tracks(len(seconds))[name]}, seconds=seconds)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", list(tracks(1)))
def test_tables_give_the_times_back(name: str, kind: str, tmp_path: Path) -> None:
    for seed in range(3):
        seconds = planted_seconds(kind, seed)
        save_take(taken(name, seconds), tmp_path / name)
        found = load_take(tmp_path / name)
        slack = 2e-5 if name == "live_link.csv" else 1e-9  # its timecodes count thousandths of a frame
        torch.testing.assert_close(found.times, seconds - seconds[0], atol=slack, rtol=0)
        if kind != "variable rate":
            assert found.fps == 30
        save_take(found, tmp_path / "again.csv" if name.endswith("csv") else tmp_path / "again.trc")
        again = load_take(tmp_path / "again.csv" if name.endswith("csv") else tmp_path / "again.trc")
        torch.testing.assert_close(again.times, found.times, atol=1e-9, rtol=0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["take.glb", "take.usda"])
def test_animations_give_the_times_back(name: str, kind: str, tmp_path: Path) -> None:
    rig, seconds = sheet_rig(), planted_seconds(kind, 5)
    weights = torch.rand(len(seconds), len(rig.names), 1, generator=torch.Generator().manual_seed(0))
    save_animation(rig, Take(30.0, weights=Track(rig.names, weights), seconds=seconds), tmp_path / name)
    found = load_animation(tmp_path / name)
    torch.testing.assert_close(found.times, seconds - seconds[0], atol=1e-6, rtol=0)
    assert found.weights.values.equal(weights)


def test_c3d_holds_dropped_frames_as_empty_ones_and_no_other_times(tmp_path: Path) -> None:
    seconds = planted_seconds("dropped frames", 2)
    take = taken("markers.trc", seconds)
    save_take(take, tmp_path / "take.c3d")
    found = load_take(tmp_path / "take.c3d")
    seen = ~found.markers.values.isnan().any(-1).any(-1)
    torch.testing.assert_close(found.times[seen], seconds - seconds[0], atol=1e-9, rtol=0)
    assert found.markers.values[seen].equal(take.markers.values)
    with pytest.raises(ValueRangeError, match=r"uneven times.*expected an even rate for C3D"):
        save_take(taken("markers.trc", planted_seconds("variable rate", 2)), tmp_path / "other.c3d")
    assert not (tmp_path / "other.c3d").exists()


@pytest.mark.parametrize("name", [name for name in tracks(1) if name != "live_link.csv"])
@pytest.mark.parametrize("change", ["backward", "shuffled", "repeated", "milliseconds"])
def test_broken_times_are_refused_or_repaired_and_said(change: str, name: str, tmp_path: Path) -> None:
    seconds = planted_seconds("variable rate", 1, 30)
    path = tmp_path / name
    save_take(taken(name, seconds), path)
    blank = "\t" if name.endswith("trc") else ","
    lines = path.read_text().splitlines()
    first = len(lines) - 30
    rows = [line.split(blank) for line in lines[first:]]
    times = [row[1] for row in rows]
    if change == "backward":
        times[7], times[8] = times[8], times[7]
    elif change == "shuffled":
        times = [times[i] for i in torch.randperm(30, generator=torch.Generator().manual_seed(0)).tolist()]
    elif change == "repeated":
        times[7] = times[6]
    else:
        times = [repr(1000 * float(time)) for time in times]
    for row, time in zip(rows, times, strict=True):
        row[1] = time
    path.write_text("\n".join([*lines[:first], *(blank.join(row) for row in rows)]) + "\n")
    if change != "milliseconds":
        with pytest.raises(FileFormatError, match=r"found time .* after .*, expected rising times"):
            load_take(path)
        return
    with pytest.warns(UserWarning, match="milliseconds"):
        found = load_take(path)
    torch.testing.assert_close(found.times, seconds - seconds[0], atol=1e-9, rtol=0)


@pytest.mark.bench
@pytest.mark.real
def test_the_real_takes_are_even_and_keep_the_times_of_what_is_left(performances: list[Path], tmp_path: Path) -> None:
    for number, path in enumerate(performances):
        whole = load_take(path)
        assert whole.seconds is None
        lines = path.read_text().splitlines(keepends=True)
        keep = torch.rand(len(whole), generator=torch.Generator().manual_seed(number)) > 0.1
        keep[0] = True
        kept = keep.nonzero().flatten()
        (tmp_path / "take.csv").write_text("".join([lines[0], *(lines[1 + row] for row in kept.tolist())]))
        found = load_take(tmp_path / "take.csv")
        assert found.fps == whole.fps
        torch.testing.assert_close(found.times, whole.times[kept], atol=1e-9, rtol=0)
        assert found.duration == pytest.approx(float(whole.times[kept[-1]]) + 1 / whole.fps)
        save_take(found, tmp_path / "again.csv")
        assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "take.csv").read_bytes()


@pytest.mark.real
def test_landmarks_at_a_thousand_a_second_are_said_to_have_no_known_rate(data: Path) -> None:
    for read in (load_take, load_landmark_table):
        with pytest.warns(UserWarning, match="1000 frames a second, which OpenCV says of videos whose rate"):
            assert read(data / "landmarks" / "openface_100_frames.csv").fps == 30


def test_timestamps_rounded_to_three_digits_have_the_rate_of_the_video(tmp_path: Path) -> None:
    for fps in (24.0, 25.0, 30000 / 1001, 30.0, 60.0):
        rows = [f"{n + 1}, {n / fps:.3f}, 0.9, 1, 10.5, 20.5" for n in range(100)]
        (tmp_path / "take.csv").write_text("\n".join(["frame, timestamp, confidence, success, x_0, y_0", *rows]) + "\n")
        found = load_take(tmp_path / "take.csv")
        assert found.fps == pytest.approx(fps, rel=1e-4)
        assert found.seconds is None


def shuffled_live_link(lines: list[str]) -> list[str]:
    return [lines[0], *(lines[1 + i] for i in torch.randperm(len(lines) - 1).tolist())]


@pytest.mark.parametrize("change", [shuffled_live_link, lambda lines: [lines[0], *lines[:0:-1]]])
def test_a_clock_that_goes_back_is_refused(change: Callable[[list[str]], list[str]], tmp_path: Path) -> None:
    save_live_link(Take(60.0, weights=tracks(200)["live_link.csv"]), tmp_path / "take.csv")
    (tmp_path / "take.csv").write_text("".join(change((tmp_path / "take.csv").read_text().splitlines(keepends=True))))
    with pytest.raises(FileFormatError, match=r"expected a clock"):
        load_take(tmp_path / "take.csv")
