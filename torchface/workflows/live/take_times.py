"""When the frames of a take that was performed live are shown."""

from dataclasses import replace

import numpy as np
from torch import Tensor

from torchface.io.tables.frame_rates import PAUSE, TimeSource, common_rate, file_error, frame_times, typical_rate
from torchface.number_checks import MAX_FPS, MIN_FPS

_LEAST = 5e-4  # seconds between frames: what all files of a take keep, those in single precision up to two hours
_TICK = 1 / 60_000  # seconds, which timecodes count
_SPACED, _SLOWEST = 1.25 * PAUSE, 5.0  # steps, but not more seconds, between frames kept of a time when nobody sends
_HELD, _RELAXED = 0.5, 4.0  # seconds in which nobody sends: nothing moves before and after; networks pause for less
_OFF, _SHARE, _DRIFT = 0.1, 0.25, 2e-4  # of clocks: seconds, but not more of a take; seconds a second
_DRIFTED = 0.25  # of a frame
_OWN_RATE = 1e-4  # by which a rate may differ from the source's stated one


def take_times(
    time: np.ndarray, fresh: np.ndarray, sent: np.ndarray, stated: float
) -> tuple[np.ndarray, float, Tensor | None]:
    """Times and rate that a reader of any file of a take finds.

    Frames that nobody sent are left out; of a pause a few are kept, so that nothing moves towards what comes after it.

    Args:
        time: when each frame came, (T,), seconds.
        fresh: whether somebody sent it, (T,).
        sent: when, by the sender's clock, (T,), seconds; NaN where it has none.
        stated: the source's rate, which a take has whose times say nothing.

    Returns:
        the frames that are kept, (K,), their rate, and when they are shown, (K,), where they come unevenly.
    """
    times, fresh = np.array(time), np.array(fresh)
    if not fresh.any():
        fresh[:] = True
    came = np.flatnonzero(fresh)
    times[came], late = _by_sender(times[came], np.asarray(sent)[came])
    times[~fresh] -= late
    if float(np.ptp(times[came])) <= _LEAST * (len(came) - 1):
        return came, stated, None
    rate = typical_rate(np.diff(_rising(times[came])))
    kept = _with_pauses(times, fresh, min(_SPACED / rate, _SLOWEST))
    times = np.rint(_rising(times[kept]) / _TICK) * _TICK
    rate = max(MIN_FPS, typical_rate(np.diff(times)))
    if rate > MAX_FPS:
        return came, stated, None
    rate = stated if abs(rate / stated - 1) <= _OWN_RATE else common_rate(rate)
    source = TimeSource(file_error("recording"), rate=rate, resolution=_TICK, seconds=True)
    found = frame_times(times, source)
    end = (len(times) - 1) / found.fps if found.seconds is None else float(found.seconds[-1])
    if abs(end - times[-1]) > _DRIFTED / rate:  # a common rate that is not the camera's
        found = frame_times(times, replace(source, rate=None))
    return kept, found.fps, found.seconds


def _by_sender(came: np.ndarray, sent: np.ndarray) -> tuple[np.ndarray, float]:
    """Times (T,) by the sender's clock, where it goes as this machine's does, and by how much frames came later; else
    the times at which they came."""
    if not (np.isfinite(sent).all() and (np.diff(sent) > 0).all()):
        return came, 0.0
    late = came - sent
    late -= late.min()
    # Of a clock that jumps or goes at another rate the least from there on, or up to there, is large as well.
    least = max(np.minimum.accumulate(late).max(), np.minimum.accumulate(late[::-1]).max())
    duration = float(came[-1] - came[0])
    if least > min(_OFF + _DRIFT * duration, _SHARE * duration):
        return came, 0.0
    return sent - sent[0], float((came - sent).max() + sent[0])


def _rising(times: np.ndarray) -> np.ndarray:
    """Times (T,) from 0 that rise by ``_LEAST`` or more; those that do are as they were."""
    least = _LEAST * np.arange(len(times))
    return np.maximum.accumulate(times - times[0] - least) + least


def _with_pauses(times: np.ndarray, fresh: np.ndarray, spaced: float) -> np.ndarray:
    """Rows that came; of those in pauses some that are ``spaced`` seconds apart, and the last one of each pause."""
    kept, heard, last = list[int](), 0.0, 0.0
    came = np.flatnonzero(fresh)
    for row in range(came[0], came[-1] + 1):
        pause = times[row] - heard
        if fresh[row]:
            if kept and row - 1 > kept[-1] and times[row - 1] - heard > max(spaced, _HELD):
                kept.append(row - 1)
            heard = times[row]
        elif times[row] - last <= spaced or not _HELD < pause <= _RELAXED:
            continue
        kept.append(row)
        last = times[row]
    return np.array(kept)
