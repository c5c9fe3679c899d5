"""What a video's compressed packets say: when each frame is shown, and how large the key frames are."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchface.io.video.container import open_container, pyav, reason

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream


@dataclass(frozen=True, eq=False)
class Packets:
    """The packets of a video.

    Args:
        seconds: when the frame of each is shown, (P,) float64, rising; NaN where the file does not say, at the end.
        hidden: how many more there are that an edit list leaves out.
    """

    seconds: np.ndarray
    hidden: int


def packets_of(container: InputContainer, stream: VideoStream, errors: list[str]) -> Iterator[Packet | None]:
    """A stream's packets up to the first that cannot be read, then None, which flushes a decoder.

    What is wrong with that one goes to ``errors``. Empty packets, which stand for a repeated frame, are left out: a
    decoder would take one for the end.
    """
    try:
        for packet in container.demux(stream):
            if packet.size:
                yield packet
    except (pyav().FFmpegError, ValueError) as error:
        errors.append(f" ({reason(error)})")
    yield None


def read_packets(path: Path) -> Packets:
    """Reads packets without decoding them, up to the first that cannot be read.

    Raises:
        FileFormatError: as ``open_container``.
    """
    seconds, hidden = array("d"), 0
    with open_container(path) as (container, stream):
        for packet in packets_of(container, stream, []):
            if packet is None:
                continue
            if packet.is_discard:
                hidden += 1
                continue
            time = packet.dts if packet.pts is None else packet.pts
            seconds.append(np.nan if time is None else float(time * packet.time_base))
    return Packets(np.sort(np.frombuffer(seconds, np.float64)), hidden)


def key_frame_sizes(path: Path) -> Iterator[tuple[float, int, int]]:
    """Decodes the key frames alone and gives the time in seconds, width and height of each, upright.

    Raises:
        FileFormatError: as ``open_container``.
    """
    with open_container(path) as (container, stream):
        tick = float(stream.time_base or 0)
        for packet in packets_of(container, stream, []):
            if packet is None or packet.is_keyframe:
                try:
                    for frame in stream.decode(packet):
                        size = (frame.height, frame.width) if quarter_turns(frame) % 2 else (frame.width, frame.height)
                        yield (np.nan if frame.pts is None else frame.pts * tick), *size
                except (pyav().FFmpegError, ValueError):  # decoding every frame says what is wrong
                    continue


def quarter_turns(frame: VideoFrame) -> int:
    """By how many quarter turns, counter-clockwise, a stored frame comes upright, as its display matrix says."""
    return round(frame.rotation / 90)
