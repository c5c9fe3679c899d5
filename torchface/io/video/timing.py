"""Whether a video's frames come at an even rate."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchface.errors import FileFormatError
from torchface.io.tables.frame_rates import USUAL

_WINDOW = 15
_RATE_CHANGE = 0.1
_ROUNDING = 0.0005  # seconds: Matroska counts whole milliseconds
_HOLE = 0.5
_HOLES = 0.01
_SPREAD = 0.25  # a jitter of ±0.2 frames in the times makes 0.16 in how long frames last


def check_even_rate(path: Path, seconds: np.ndarray, fps: float) -> None:
    """Refuses a video of variable frame rate: what is solved counts in frames of one length.

    Cameras of telephones jitter by some milliseconds and lose a frame now and then: that passes. What does not: a
    rate that changes by more than a tenth, fifteen frames taken together, frames that last differently by more than a
    quarter (root mean square), and holes in which more than one frame in a hundred is missing.

    Args:
        path: for the message.
        seconds: when each frame is shown, (P,), in any order; a time that stands twice is no time.
        fps: what the header says.

    Raises:
        FileFormatError: the message says how frames last and how to convert the file.
    """
    lasts = np.diff(np.unique(seconds[np.isfinite(seconds)]))
    if len(lasts) < 3:
        return
    usual = float(np.median(lasts))
    holes = np.abs(lasts / usual - 1) > _HOLE
    usual = float(lasts[~holes].mean())
    missing = int(np.maximum(np.rint(np.abs(lasts[holes] / usual - 1)), 1).sum())
    window = min(_WINDOW, len(lasts))
    means = np.convolve(np.where(holes, usual, lasts), np.full(window, 1 / window), mode="valid")
    allowed = _RATE_CHANGE * usual + _ROUNDING
    if missing > 1 + _HOLES * len(lasts):
        what = f"{int(holes.sum())} of {len(lasts)} last more than half a frame longer or shorter"
    elif (spread := float(np.sqrt(np.mean((lasts[~holes] / usual - 1) ** 2)))) > _SPREAD:
        what = f"they differ by {100 * spread:.0f} %"
    elif means.max() - means.min() > allowed:
        worst = int(np.abs(means - usual).argmax())
        what = f"from frame {worst} to {worst + window} they last {1000 * means[worst]:.1f} ms each"
    elif abs(float(lasts.mean()) - 1 / fps) > allowed:
        what = f"its header says {fps:g} frames a second"
    else:
        return
    rate = min(USUAL, key=lambda other: abs(other - 1 / usual))
    raise FileFormatError(
        f"{path}: found a variable frame rate: frames last {1000 * usual:.1f} ms as a rule, but {what} "
        f"({1000 * lasts.min():.1f} to {1000 * lasts.max():.1f} ms); expected an even rate. "
        f"To convert it: ffmpeg -i {path.name} -vf fps={rate:.5g} {path.stem}_even.mp4"
    )
