"""Evenness of a video's frame rate."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchface.errors import FileFormatError
from torchface.io.tables.frame_rates import COMMON_RATES

_WINDOW = 15
_MAX_RATE_CHANGE = 0.1
_ROUNDING = 0.0005  # seconds: Matroska counts whole milliseconds
_HOLE = 0.5  # frames by which a duration differs from the usual one
_MAX_MISSING = 0.01
_MAX_DEVIATION = 0.25  # a jitter of ±0.2 frames in the times makes 0.16 in the durations


def check_even_rate(path: Path, seconds: np.ndarray, fps: float) -> None:
    """Refuses a video of variable frame rate, where what reads it counts in frames of one length.

    Args:
        path: for the message.
        seconds, fps: as of :func:`rate_changes`.
    """
    changes = rate_changes(seconds, fps)
    if changes:
        usual = float(np.median(np.diff(np.unique(seconds[np.isfinite(seconds)]))))
        rate = min(COMMON_RATES, key=lambda other: abs(other - 1 / usual))
        raise FileFormatError(
            f"{path}: found a variable frame rate: {changes}; expected an even rate. "
            f"To convert it: ffmpeg -i {path.name} -vf fps={rate:.5g} {path.stem}_even.mp4"
        )


def rate_changes(seconds: np.ndarray, fps: float) -> str:
    """How a video's frame rate varies, in words; empty where it is even.

    Phone cameras jitter by some milliseconds and lose a frame now and then: that passes. What does not: a rate that
    changes by more than a tenth, averaged over fifteen frames, durations that deviate by more than a quarter (root mean
    square), and holes in which more than one frame in a hundred is missing.

    Args:
        seconds: when each frame is shown, (P,), in any order; a repeated time counts once.
        fps: what the header says.
    """
    durations = np.diff(np.unique(seconds[np.isfinite(seconds)]))
    if len(durations) < 3:
        return ""
    usual = float(np.median(durations))
    holes = np.abs(durations / usual - 1) > _HOLE
    usual = float(durations[~holes].mean())
    missing = int(np.maximum(np.rint(np.abs(durations[holes] / usual - 1)), 1).sum())
    window = min(_WINDOW, len(durations))
    means = np.convolve(np.where(holes, usual, durations), np.full(window, 1 / window), mode="valid")
    allowed = _MAX_RATE_CHANGE * usual + _ROUNDING
    deviation = float(np.sqrt(np.mean((durations[~holes] / usual - 1) ** 2)))
    if missing > 1 + _MAX_MISSING * len(durations):
        what = f"{int(holes.sum())} of {len(durations)} last more than half a frame longer or shorter"
    elif deviation > _MAX_DEVIATION:
        what = f"they differ by {100 * deviation:.0f} %"
    elif means.max() - means.min() > allowed:
        worst = int(np.abs(means - usual).argmax())
        what = f"from frame {worst} to {worst + window} they last {1000 * means[worst]:.1f} ms each"
    elif abs(float(durations.mean()) - 1 / fps) > allowed:
        what = f"its header says {fps:g} frames a second"
    else:
        return ""
    return (
        f"frames last {1000 * usual:.1f} ms as a rule, but {what} "
        f"({1000 * durations.min():.1f} to {1000 * durations.max():.1f} ms)"
    )
