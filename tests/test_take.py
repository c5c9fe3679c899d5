"""Take and Track: frames agree, channels go by name."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from torchface.errors import ArgumentTypeError, NameMismatchError, ShapeError, TorchfaceError, ValueRangeError
from torchface.take import Take, Track, empty_frames


def test_selecting_channels_follows_names_not_order() -> None:
    track = Track(("a", "b", "c"), torch.arange(12.0).reshape(2, 3, 2), torch.arange(6.0).reshape(2, 3) / 6)
    picked = track.select(["c", "a"])
    assert torch.equal(picked.values, track.values[:, [2, 0]])
    assert torch.equal(picked.confidence, track.confidence[:, [2, 0]])
    assert torch.equal(picked.frames(slice(1, 2)).values, track.values[1:, [2, 0]])


def test_disagreements_are_named() -> None:
    track = Track(("a",), torch.zeros(4, 1, 3))
    with pytest.raises(NameMismatchError, match="no channel 'x'"):
        track.select(["x"])
    with pytest.raises(NameMismatchError, match="more than once: a"):
        Track(("a", "a"), torch.zeros(4, 2, 3))
    with pytest.raises(ShapeError, match=r"expected \(T,2,D\)"):
        Track(("a", "b"), torch.zeros(4, 3, 3))
    with pytest.raises(ShapeError, match="'markers': 4, 'weights': 5"):
        Take(60.0, markers=track, weights=Track(("w",), torch.zeros(5, 1, 1)))


@pytest.mark.parametrize("fps", [0, -60.0, 1e9, 1e-9, float("nan"), float("inf"), True, "60"])
def test_a_rate_that_no_camera_has_is_refused(fps: float) -> None:
    with pytest.raises(ValueRangeError, match=r"take: found .* frames a second, expected 0\.01 to 10000"):
        Take(fps)


@pytest.mark.parametrize(("name", "width"), [("markers", 3), ("landmarks", 2), ("weights", 1)])
def test_a_track_of_another_kind_is_refused(name: str, width: int) -> None:
    for wrong in {0, 1, 2, 3, 4} - {width}:
        with pytest.raises(ShapeError, match=rf"take: found {name} \(4, 1, {wrong}\), expected \(T,C,{width}\)"):
            Take(60.0, **{name: Track(("a",), torch.zeros(4, 1, wrong))})


def test_length_is_the_number_of_frames() -> None:
    assert len(Take(60.0, weights=Track(("w",), torch.zeros(5, 1, 1)))) == 5
    assert len(Take(60.0)) == 0


def test_a_take_is_printed_in_a_line() -> None:
    markers = Track(tuple(f"M{i:03d}" for i in range(100)), torch.zeros(500, 100, 3))
    take = Take(60.0, markers, timecode=("01:00:00:00",) * 499 + ("01:00:08:19",), extras={"source": "a.c3d"})
    assert str(take) == (
        "Take(500 frames at 60 a second, 100 markers, timecode 01:00:00:00 to 01:00:08:19, extras source)"
    )
    assert repr(markers) == "Track(500 frames of 100 x 3: M000, M001, M002, ...)"


def test_frames_without_a_marker_are_found() -> None:
    values = torch.zeros(5, 2, 3)
    values[1] = torch.nan
    values[3, :, 0] = torch.nan  # a marker with one coordinate missing was not seen
    values[4, 0] = torch.nan
    take = Take(60.0, markers=Track(("a", "b"), values))
    assert empty_frames(take).tolist() == [1, 3]
    with pytest.raises(ValueRangeError, match="take: found no markers"):
        empty_frames(Take(60.0))


def uneven() -> Take:
    seconds = torch.tensor([3.0, 3.1, 3.3, 3.35, 3.4], dtype=torch.float64)
    weights = Track(("a",), (10 * seconds - 30).float()[:, None, None], torch.ones(5, 1))
    columns = {"HeadYaw": 2 * seconds, "note": tuple("abcde")}
    return Take(10.0, weights=weights, timecode=tuple("vwxyz"), extras={"columns": columns}, seconds=seconds)


def test_times_are_those_given_or_even() -> None:
    take = uneven()
    torch.testing.assert_close(take.times, torch.tensor([0, 0.1, 0.3, 0.35, 0.4], dtype=torch.float64))
    assert take.duration == pytest.approx(0.5)
    assert take.clock.equal(take.seconds)
    even = Take(10.0, weights=take.weights, extras={"frame_numbers": torch.arange(100, 105)})
    torch.testing.assert_close(even.times, torch.arange(5, dtype=torch.float64) / 10)
    torch.testing.assert_close(even.clock, torch.arange(100, 105, dtype=torch.float64) / 10)
    assert even.duration == 0.5
    assert Take(10.0).duration == 0
    cut = take.frames(slice(2, 4))
    assert cut.seconds.tolist() == [3.3, 3.35]
    assert "uneven times, up to 0.2 s apart" in repr(take)


@pytest.mark.parametrize("seconds", [[0, 1], [0, 1, 1, 2, 3], [0, 1, 2, 3, float("nan")], [4, 3, 2, 1, 0]])
def test_times_that_do_not_rise_are_refused(seconds: list[float]) -> None:
    with pytest.raises(ValueRangeError, match=r"expected \(5,\), rising"):
        replace(uneven(), seconds=torch.tensor(seconds))


@pytest.mark.parametrize("fps", [10.0, 25.0, 7.0])
def test_resampling_keeps_lines_and_the_length(fps: float) -> None:
    even = uneven().resampled(fps)
    assert (even.fps, even.seconds, even.timecode) == (fps, None, None)
    torch.testing.assert_close(even.weights.values.flatten().double(), 10 * even.times, atol=1e-6, rtol=0)
    torch.testing.assert_close(even.extras["columns"]["HeadYaw"], 6 + 2 * even.times)
    assert "note" not in even.extras["columns"]
    assert 0.4 - 1 / fps < float(even.times[-1]) <= 0.4 + 1e-9
    assert even.resampled(fps) is even


def test_resampling_leaves_what_is_not_seen() -> None:
    values = torch.tensor([0.0, torch.nan, 2.0, 3.0, 4.0])[:, None, None]
    take = Take(10.0, weights=Track(("a",), values)).resampled(20.0)
    assert take.weights.values.isnan().flatten().nonzero().flatten().tolist() == [1, 2, 3]
    with pytest.raises(ValueRangeError, match="found 0 frames a second"):
        take.resampled(0)


def test_on_a_grid_the_frames_are_the_same_and_others_empty() -> None:
    take = uneven()
    even, rows = take.on_grid()
    assert even.fps == 20.0
    assert rows.tolist() == [0, 2, 6, 7, 8]
    assert even.weights.values[rows].equal(take.weights.values)
    empty = [row for row in range(len(even)) if row not in rows]
    assert bool(even.weights.values[empty].isnan().all())
    assert even.weights.confidence[empty].tolist() == [[0]] * 4
    torch.testing.assert_close(even.times[rows], take.times)
    same, all_rows = even.on_grid()
    assert len(same) == len(even)
    assert all_rows.equal(torch.arange(len(even)))


def test_the_frame_nearest_to_each_moment_is_shown() -> None:
    take = uneven()
    off = (take.times[:, None] - torch.arange(5) / 10).abs()
    torch.testing.assert_close(off[take.even_rows(), torch.arange(5)], off.amin(0))
    assert Take(10.0, weights=uneven().weights).even_rows().tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    "rows", [[0, 2], torch.tensor([-3, -1]), torch.tensor([True, False, True]), [True, False, True]]
)
def test_frames_are_taken_by_numbers_or_by_a_mask(rows: Any) -> None:
    take = Take(2.0, weights=Track(("a",), torch.arange(3.0)[:, None, None]), timecode=("x", "y", "z"))
    some = take.rows(rows)
    assert some.weights is not None
    assert some.weights.values.flatten().tolist() == [0.0, 2.0]
    assert (some.timecode, some.times.tolist()) == (("x", "z"), [0.0, 1.0])


@pytest.mark.parametrize(
    ("rows", "error", "says"),
    [
        (torch.tensor([0, 99]), ValueRangeError, r"found \[0, 99\], expected some of 3 frames"),
        (torch.tensor([True, False]), ValueRangeError, r"found torch.bool \(2,\), .* a mask \(3,\)"),
        (torch.tensor([0.0, 1.0]), ValueRangeError, "found torch.float32"),
        ("all", ArgumentTypeError, "the text 'all'"),
    ],
)
def test_frames_that_are_not_there_are_named(rows: Any, error: type[TorchfaceError], says: str) -> None:
    take = Take(2.0, weights=Track(("a",), torch.arange(3.0)[:, None, None]))
    with pytest.raises(error, match=says):
        take.rows(rows)
    with pytest.raises(ArgumentTypeError, match=r"frames: found .*, expected a slice"):
        take.frames(rows)
