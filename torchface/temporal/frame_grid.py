"""Even grids of frames under times that come unevenly."""

import torch
from torch import Tensor

from torchface.errors import ValueRangeError

FINEST = 8  # places a frame at most: then no frame is further from its place than a sixteenth of one

_NEAR = 0.05  # of a frame
_LONGEST = 20  # places a frame of the take, and
_ALWAYS = 100_000  # places that are always allowed


def frame_grid(seconds: Tensor, fps: float) -> tuple[float, Tensor]:
    """The coarsest even grid that has a place of its own near each of the times.

    Frames that were dropped leave places free at the take's own rate; frames at any times need a finer grid.

    Returns:
        Places a second, a multiple of ``fps``, and the place of each frame, (T,) int64, rising from 0.
    """
    since = seconds.double() - seconds[0]
    check_gaps(since, fps)
    for finer in range(1, FINEST + 1):
        exact = since * (finer * fps)
        place = exact.round().long()
        near = float((exact - place).abs().max()) <= _NEAR * finer
        if (near or finer == FINEST) and bool((place.diff() > 0).all()):
            return finer * fps, place
    # Two frames nearer than an eighth of a frame: the later one goes to the next place that is free.
    place = (since * (FINEST * fps)).round().long() - torch.arange(len(since))
    return FINEST * fps, place.cummax(0).values + torch.arange(len(since))


def check_gaps(times: Tensor, fps: float) -> None:
    """Raises ``ValueRangeError`` where an even rate over times (T,) from 0 would fill the memory with gaps."""
    places = float(times[-1]) * fps
    if places > max(_LONGEST * len(times), _ALWAYS):
        raise ValueRangeError(
            f"take: found a gap of {float(times.diff().max()):.6g} s among {len(times)} frames, {places:.0f} frames at "
            f"{fps:g} a second, expected frames that follow one another: cut the take there"
        )
