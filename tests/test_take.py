"""Take and Track: frames agree, channels go by name."""

import pytest
import torch

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.take import Take, Track, empty_frames


def test_selecting_channels_follows_names_not_order() -> None:
    track = Track(("a", "b", "c"), torch.arange(12.0).reshape(2, 3, 2), torch.arange(6.0).reshape(2, 3) / 6)
    picked = track.select(["c", "a"])
    assert torch.equal(picked.values, track.values[:, [2, 0]])
    assert picked.confidence is not None
    assert track.confidence is not None
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
            Take(60.0, **{name: Track(("a",), torch.zeros(4, 1, wrong))})  # type: ignore[arg-type]


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
