"""Videos that PyAV encodes: every codec, any times, rotated, of two sizes."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.codec import CodecContext
from av.packet import Packet

RATE = 30
TICKS = 60_000
OPTIONS = {
    "libx264": {"x264-params": "mbtree=0"},  # with it the same frames are not always coded into the same bytes
    "libsvtav1": {"preset": "12"},
    "libx265": {"x265-params": "log-level=none"},
    "mpeg4": {"qmax": "4"},
    "libvpx": {"deadline": "realtime", "cpu-used": "8"},
    "libvpx-vp9": {"deadline": "realtime", "cpu-used": "8"},
}


def pattern(number: int, width: int = 160, height: int = 120) -> np.ndarray:
    """A picture that moves, uint8 (H,W,3), without fine detail."""
    y, x = np.mgrid[:height, :width]
    waves = [np.sin((x + 3 * number) / 23), np.sin((y - 2 * number) / 17), np.sin((x + y + 5 * number) / 31)]
    return (127.5 + 100 * np.stack(waves, -1)).astype(np.uint8)


def encode(
    path: Path,
    codec: str,
    count: int = 30,
    size: tuple[int, int] = (160, 120),
    pixels: str = "yuv420p",
    times: Sequence[float] | None = None,
    rotation: int = 0,
    second_size: tuple[int, int] | None = None,
    shift: int = 0,
    options: dict[str, str] | None = None,
) -> Path:
    """Writes ``pattern``; a second stream of ``second_size`` follows in the same track.

    Args:
        times: seconds of each frame; even ones at 30 a second if absent.
        rotation: in degrees, that players are to turn frames by, counter-clockwise.
        shift: by how many frames the times of all packets are moved ahead: an edit list hides those before 0.
        options: of the container.
    """
    _require(codec)
    with _scheduling_kept(), av.open(str(path), "w", container_options=options or {}) as container:
        stream = container.add_stream(codec, rate=RATE, options=OPTIONS.get(codec, {}))
        stream.width, stream.height, stream.pix_fmt = *size, pixels
        stream.codec_context.time_base = Fraction(1, RATE if times is None else TICKS)
        if rotation:
            stream.set_display_rotation(rotation)
        packets = _packets(stream, size, pixels, range(count), times)
        if second_size is not None:
            second = CodecContext.create(codec, "w")
            second.width, second.height, second.pix_fmt = *second_size, pixels
            second.framerate, second.time_base, second.options = RATE, Fraction(1, RATE), OPTIONS.get(codec, {})
            packets += _packets(second, second_size, pixels, range(count, 2 * count), None)
        for packet in packets:
            ahead = round(shift / RATE / packet.time_base)
            packet.pts, packet.dts = packet.pts - ahead, packet.dts - ahead
            packet.stream = stream
            container.mux(packet)
    return path


def _packets(
    encoder: av.VideoStream | CodecContext,
    size: tuple[int, int],
    pixels: str,
    numbers: range,
    times: Sequence[float] | None,
) -> list[Packet]:
    found = []
    for i in numbers:
        frame = av.VideoFrame.from_ndarray(pattern(i, *size), format="rgb24").reformat(format=pixels)
        frame.time_base = Fraction(1, RATE if times is None else TICKS)
        frame.pts = i if times is None else round(times[i] * TICKS)
        found += encoder.encode(frame)
    return found + encoder.encode(None)


@contextmanager
def _scheduling_kept() -> Iterator[None]:
    """Run by root, SVT-AV1 gives the thread that calls it real-time priority, before which all others starve."""
    if sys.platform != "linux":
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)


def _require(codec: str) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"this FFmpeg has no {codec}")
