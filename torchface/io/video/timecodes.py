"""Timecodes of films: the time of day at which the first frame was taken."""

import re
from pathlib import Path

from torchface.io.video.video_packets import open_container

_TIMECODE = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})([:;.])(\d{2,3})")


def start_of(film: str | Path) -> float | None:
    """When a film's first frame was taken by its timecode, seconds from midnight; None where it has none."""
    path = Path(film)
    with open_container(path) as (container, stream):
        rate = float(stream.average_rate or stream.guessed_rate or 0)
        kept = [container.metadata, *(one.metadata for one in container.streams)]
    text = next((tags["timecode"] for tags in kept if "timecode" in tags), "")
    return seconds_of(text, rate)


def seconds_of(text: str, rate: float) -> float | None:
    """Seconds of a timecode HH:MM:SS:FF of a frame rate; with a semicolon frame numbers are dropped as SMPTE 12M says.

    Example:
        >>> seconds_of("01:00:00:12", 24.0)
        3600.5
        >>> round(seconds_of("00:10:00;00", 30000 / 1001), 2)
        600.0
    """
    match = _TIMECODE.fullmatch(text.strip())
    if match is None or rate < 1:
        return None
    hours, minutes, seconds, frames = (int(match[k]) for k in (1, 2, 3, 5))
    count = (3600 * hours + 60 * minutes + seconds) * round(rate) + frames
    if match[4] == ";":
        passed = 60 * hours + minutes
        count -= round(rate / 15) * (passed - passed // 10)
    return count / rate
