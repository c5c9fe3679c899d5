"""Writing video files, grey or in colour."""

import math
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.files.whole_files import check_ending, replaced_file
from torchface.io.video.film_sound import add_sound
from torchface.io.video.video_file import VideoFile, open_video
from torchface.io.video.video_packets import pyav, read_packets, reason
from torchface.number_checks import check_rate

if TYPE_CHECKING:
    from av.container import OutputContainer
    from av.packet import Packet
    from av.video.stream import VideoStream

_FORMATS = {".avi": "avi", ".mkv": "matroska", ".mp4": "mp4"}
WRITTEN_ENDINGS = tuple(_FORMATS)  # of videos that are written
_BT709, _LIMITED = 1, 1  # H.273's numbers of matrix, primaries and transfer; FFmpeg's of the range
_LOSSY = ("yuv420p", "yuv444p")
_MAX_MPEG4_TICKS, _MAX_BIT_RATE = 65535, 2**30
_TICK = Fraction(1, 60000)  # seconds in which uneven times are counted
_MKV_TICK = Fraction(1, 1000)  # seconds in which Matroska counts


def write_video(
    frames: Iterable[Tensor],
    path: str | Path,
    fps: float,
    times: Tensor | None = None,
    sound: str | Path | None = None,
    crf: int = 16,
) -> VideoFile:
    """Writes frames and reads the file back; it appears only when it is complete.

    Args:
        frames: grey chunks (t,H,W) or single grey frames (H,W), or chunks in colour (t,3,H,W), red first; uint8, or
            floats in [0,1]; all of one size, all grey or all in colour. Three dimensions are always grey: a single
            frame in colour is (1,3,H,W).
        path: ``.avi`` and ``.mkv`` are lossless (FFV1), ``.mp4`` (H.264, or MPEG-4 where FFmpeg lacks x264) is not.
        fps: frames a second; in the mean, where there are ``times``.
        times: when each frame is shown, (T,) seconds, rising from 0; evenly if absent. ``.avi`` cannot hold them.
        sound: a film whose sound is copied as it is; left out where the file cannot hold it so, or not
            at its times.
        crf: x264's number of quality, 0 to 51; 6 more halve the file.

    Raises:
        FileFormatError: another ending, or the file cannot be written or cannot hold ``times``.
        ShapeError: no frames, frames that differ in size, or grey ones among those in colour.
        ValueRangeError: ``fps`` is no camera's, or ``times`` do not rise from 0 or are not as many as the frames.

    Example:
        >>> noise = torch.randint(0, 256, (4, 16, 32), dtype=torch.uint8)
        >>> torch.equal(write_video([noise], "noise.mkv", fps=30.0).frame(2), noise[2])
        True
    """
    path = Path(path)
    check_ending(path, *WRITTEN_ENDINGS)
    check_rate(fps, "fps", ValueRangeError)
    if times is not None and path.suffix.lower() == ".avi":
        raise FileFormatError(f"{path}: .avi holds frames at an even rate alone, expected .mp4 or .mkv for others")
    if times is not None:
        _check_times(times, _MKV_TICK if path.suffix.lower() == ".mkv" else _TICK)
    single = _single(frames)
    first = next(single, None)
    if first is None:
        raise ShapeError(f"{path}: found no frame, expected at least one")
    av = pyav()
    with replaced_file(path) as temporary:
        try:
            with av.open(str(temporary), "w", format=_FORMATS[path.suffix.lower()]) as container:
                stream = _add_stream(container, first, fps, times, crf)
                heard = iter(()) if sound is None else add_sound(Path(sound), container)
                count = _encode(container, stream, chain([first], single), times, heard)
        except av.FFmpegError as error:
            if isinstance(error, OSError):
                raise
            raise FileFormatError(f"{path}: cannot be written ({reason(error)})") from error
        written = VideoFile(path, fps, first.shape[-1], first.shape[-2], count)
        _check_written(written, temporary)
    return written


def to_bytes(frame: Tensor) -> Tensor:
    """Grey or colour values as uint8, of the same shape; floats are in [0,1].

    Example:
        >>> to_bytes(torch.tensor([0.0, 0.5, 1.0])).tolist()
        [0, 128, 255]
    """
    if frame.dtype == torch.uint8:
        return frame.contiguous()
    return (frame.clamp(0, 1) * 255).round().to(torch.uint8).contiguous()


def _check_times(times: Tensor, tick: Fraction) -> None:
    """Refuses times (T,) that are no seconds rising from 0 by at least a tick."""
    if times.ndim != 1:
        raise ShapeError(f"times: found {tuple(times.shape)}, expected (T,)")
    before = -1
    for t, seconds in enumerate(times.tolist()):
        now = round(seconds / tick) if math.isfinite(seconds) else before
        if now <= before or (t == 0 and now != 0):
            found = f"{seconds:g} s after {float(times[t - 1]):g} s" if t else f"{seconds:g} s"
            raise ValueRangeError(
                f"times: found {found} for frame {t}, expected seconds that rise from 0, by {float(tick):.2g} at least"
            )
        before = now


def _check_written(expected: VideoFile, temporary: Path) -> None:
    """Reads the file back, its packets and its first frame: an encoder may report success on a full disk."""
    try:
        copy = open_video(temporary)
        frames = len(read_packets(temporary).seconds)
    except FileFormatError as error:
        message = str(error).replace(str(temporary), "read back")
        raise FileFormatError(f"{expected.path}: cannot be written ({message}); is the disk full?") from error
    if (frames, copy.width, copy.height) != (expected.count, expected.width, expected.height):
        raise FileFormatError(
            f"{expected.path}: cannot be written: read back, found {frames} frames of {copy.width} x {copy.height} "
            f"pixels, expected {expected.count} of {expected.width} x {expected.height}; is the disk full?"
        )


def _encode(
    container: "OutputContainer",
    stream: "VideoStream",
    frames: Iterator[Tensor],
    times: Tensor | None,
    sound: "Iterator[tuple[float, Packet]]",
) -> int:
    """Writes all frames, and packets of sound between them, and gives the number of frames."""
    lossy = {"dst_colorspace": _BT709, "dst_color_range": _LIMITED} if stream.pix_fmt in _LOSSY else {}
    av = pyav()
    reformatter = av.video.reformatter.VideoReformatter()
    count, size, heard = 0, None, next(sound, None)
    for frame in frames:  # the encoder takes one frame at a time
        size = size or frame.shape
        if frame.shape != size:
            raise ShapeError(f"frames: found {tuple(frame.shape)}, expected {tuple(size)} as the first")
        pixels = frame.numpy() if frame.dtype == torch.uint8 else to_bytes(frame).numpy()
        pixels = np.ascontiguousarray(pixels if pixels.ndim == 2 else pixels.transpose(1, 2, 0))
        layout = "rgb24" if pixels.ndim == 3 else "gray"
        coded = reformatter.reformat(av.VideoFrame.from_ndarray(pixels, layout), format=stream.pix_fmt, **lossy)
        if times is not None and count >= len(times):
            raise ValueRangeError(f"times: found {len(times)}, expected one for each frame, which are more")
        coded.time_base = stream.codec_context.time_base
        coded.pts = count if times is None else round(float(times[count]) / coded.time_base)
        container.mux(stream.encode(coded))
        count += 1
        while heard is not None and heard[0] <= coded.pts * coded.time_base:
            container.mux(heard[1])
            heard = next(sound, None)
    if times is not None and count < len(times):
        raise ValueRangeError(f"times: found {len(times)}, expected one for each of {count} frames")
    container.mux(stream.encode(None))
    for _, packet in () if heard is None else chain([heard], sound):
        container.mux(packet)
    return count


def _add_stream(
    container: "OutputContainer", first: Tensor, fps: float, times: Tensor | None, crf: int
) -> "VideoStream":
    """A stream for frames as the first: FFV1 for a lossless container, else H.264 or MPEG-4 in BT.709."""
    height, width = first.shape[-2:]
    lossless = container.format.name != "mp4"
    codec = "ffv1" if lossless else "libx264" if "libx264" in pyav().codecs_available else "mpeg4"
    # With macroblock trees x264 does not always code the same frames into the same bytes; where to place B-frames need
    # not be searched for: seven films became no larger, with the same errors, in nine tenths of the time.
    options = {}
    if codec == "libx264":
        options = {"preset": "superfast", "crf": str(crf), "x264-params": "mbtree=0:b-adapt=0"}
    stream = cast("VideoStream", container.add_stream(codec, rate=_rate(fps, codec), options=options))
    stream.width, stream.height = width, height
    stream.codec_context.time_base = 1 / stream.codec_context.framerate if times is None else _TICK
    if lossless:
        stream.pix_fmt = "bgr0" if first.ndim == 3 else "gray"
        return stream
    if codec == "mpeg4":
        stream.bit_rate = min(round(4 * width * height * fps), _MAX_BIT_RATE)
    even = width % 2 == 0 and height % 2 == 0
    stream.pix_fmt = "yuv420p" if even or codec == "mpeg4" else "yuv444p"
    context = stream.codec_context
    context.colorspace = context.color_primaries = context.color_trc = _BT709
    context.color_range = _LIMITED
    return stream


def _rate(fps: float, codec: str) -> Fraction:
    """Frames a second as the codec's header can hold it."""
    largest = _MAX_MPEG4_TICKS // math.ceil(fps) if codec == "mpeg4" else 100_000
    return Fraction(fps).limit_denominator(largest)


def _single(frames: Iterable[Tensor]) -> Iterator[Tensor]:
    """Frames (H,W) or (3,H,W) one by one."""
    for chunk in frames:
        if chunk.ndim not in (2, 3, 4) or (chunk.ndim == 4 and chunk.shape[1] != 3):
            raise ShapeError(f"frames: found {tuple(chunk.shape)}, expected (H,W), (t,H,W), or (t,3,H,W) in colour")
        yield from chunk if chunk.ndim > 2 else chunk[None]
