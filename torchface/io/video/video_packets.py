"""Packets of a video: when each frame is shown, and how large the key frames are."""

from __future__ import annotations

import os
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchface.errors import FileFormatError
from torchface.files.extra_packages import import_extra
from torchface.files.whole_files import checked_size

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.stream import Stream
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream


@dataclass(frozen=True, eq=False)
class Packets:
    """The packets of a video."""

    # When the frame of each is shown, (P,) float64, rising; NaN where the file does not say, at the end.
    seconds: np.ndarray
    hidden: int  # how many more there are that an edit list leaves out
    end: float  # when the last packet of any stream ends, sound too, seconds; 0 where none says


def packets_of(container: InputContainer, stream: Stream | None, errors: list[str]) -> Iterator[Packet | None]:
    """A stream's packets, or all streams', up to the first that cannot be read, then None, which flushes a decoder.

    What is wrong with that one goes to ``errors``. Empty packets, which stand for a repeated frame, are left out: a
    decoder would take one for the end.
    """
    try:
        for packet in container.demux(() if stream is None else stream):
            if packet.size:
                yield packet
    except (pyav().FFmpegError, ValueError) as error:
        errors.append(f" ({reason(error)})")
    yield None


def read_packets(path: Path) -> Packets:
    """Reads packets without decoding them, up to the first that cannot be read."""
    seconds, hidden, end = array("d"), 0, 0.0
    with open_container(path) as (container, stream):
        for packet in packets_of(container, None, []):
            if packet is None:
                continue
            time = packet.dts if packet.pts is None else packet.pts
            if time is not None:
                end = max(end, float((time + (packet.duration or 0)) * packet.time_base))
            if packet.stream_index != stream.index:
                continue
            if packet.is_discard:
                hidden += 1
                continue
            seconds.append(np.nan if time is None else float(time * packet.time_base))
    return Packets(np.sort(np.frombuffer(seconds, np.float64)), hidden, end)


def key_frame_sizes(path: Path) -> Iterator[tuple[float, int, int]]:
    """Decodes the key frames alone and gives the time in seconds, width and height of each, upright."""
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


def is_interlaced(stream: VideoStream) -> bool:
    """Whether a stream's header says that its frames are of two fields."""
    return stream.codec_context.field_order > _PROGRESSIVE


def without_fields(stream: VideoStream, frames: Iterator[VideoFrame], errors: list[str]) -> Iterator[VideoFrame]:
    """Frames, of an interlaced video each made whole by FFmpeg's bwdif from its first field and those beside it.

    The two fields of a frame are half a frame apart in time: in what moves every second line lies elsewhere. What is
    wrong goes to ``errors`` and ends the frames.
    """
    av, first = pyav(), next(frames, None)
    if first is None:
        return
    if not (first.interlaced_frame or is_interlaced(stream)):
        yield first
        yield from frames
        return
    graph = av.filter.Graph()
    made_whole = graph.add("bwdif", "mode=send_frame:deint=interlaced")
    graph.add_buffer(template=stream).link_to(made_whole)
    made_whole.link_to(graph.add("buffersink"))
    graph.configure()
    for frame in chain((first,), frames, (None,)):  # None flushes what waits for the frame after it
        try:
            graph.push(frame)
            while True:
                yield graph.pull()
        except (av.BlockingIOError, av.EOFError):
            continue
        except (av.FFmpegError, ValueError) as error:
            errors.append(f" ({reason(error)})")
            return


def quarter_turns(frame: VideoFrame) -> int:
    """By how many quarter turns, counter-clockwise, a stored frame comes upright, as its display matrix says."""
    return round(frame.rotation / 90)


def square_size(path: Path, stream: VideoStream, width: int, height: int) -> tuple[int, int]:
    """The size at which a stored frame has square pixels: what is narrow in it is made wider, nothing narrower."""
    ratio = float(stream.sample_aspect_ratio or 1)
    if not 1 / _MAX_ASPECT <= ratio <= _MAX_ASPECT:
        raise FileFormatError(
            f"{path}: found pixels {ratio:g} times as wide as high, expected {1 / _MAX_ASPECT:g} to {_MAX_ASPECT:g}"
        )
    wide, high = round(width * max(ratio, 1.0)), round(height * max(1 / ratio, 1.0))
    if wide > _MAX_SIDE or high > _MAX_SIDE or wide * high > _MAX_PIXELS:
        raise FileFormatError(
            f"{path}: found frames of {width} x {height} pixels, {wide} x {high} square ones, expected at most "
            f"{_MAX_SIDE} a side and {_MAX_PIXELS} in all"
        )
    return wide, high


_PROGRESSIVE = 1  # FFmpeg's number of that order of fields; 0 stands for unknown
_MAX_ASPECT = 4.0
_MAX_BYTES = 2**36
_MAX_SIDE = 8192
_MAX_PIXELS = 4096 * 4096
_BYTES_ALWAYS, _BYTES_PER_BYTE = 490 * 2**20, 18
_REFERENCES = {"h264": 16, "hevc": 16, "vvc": 16, "vp9": 8, "libdav1d": 10, "av1": 10, "libaom-av1": 10}
_FEW_REFERENCES = 3  # of other codecs, those that keep every frame whole among them
_CONVERTED_BYTES = 6  # a pixel, as red, green and blue and in the chunk that is given
_USUAL_BITS = 12  # a pixel, known only from a frame
_MOV_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")


def pyav() -> Any:
    """PyAV, loaded with the first video: its wheel brings GPL libraries, which nothing else should load or need."""
    return import_extra("av", "av", "", "video")


@contextmanager
def open_container(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """The container of a file and its video stream, ready to be decoded.

    FFmpeg would also follow playlists that name other files and addresses: the demuxer is named here, by the file's
    first bytes. No frame of more than 4096 x 4096 pixels is decoded, nor one of which as many as the codec may hold
    take more than 490 MiB, or 18 times the file.
    """
    av = pyav()
    demuxer = _demuxer(path)
    limit = {"max_pixels": str(_MAX_PIXELS)}
    opening = limit | {"skip_frame": "all"}  # FFmpeg would decode a frame of each stream, and there may be hundreds
    try:
        container = av.open(str(path.resolve()), "r", format=demuxer, options=opening, metadata_errors="replace")
    except (av.FFmpegError, ValueError) as error:
        raise FileFormatError(f"{path}: cannot be opened as a video: cut off or damaged ({reason(error)})") from error
    with container:
        stream = container.streams.best("video")
        if not isinstance(stream, av.VideoStream) or stream.codec_context is None:
            raise FileFormatError(f"{path}: found no video stream of a codec that FFmpeg knows, expected one")
        context = stream.codec_context
        width, height = context.width, context.height
        if not (0 <= width <= _MAX_SIDE and 0 <= height <= _MAX_SIDE and width * height <= _MAX_PIXELS):
            raise FileFormatError(
                f"{path}: found frames of {width} x {height} pixels, expected at most {_MAX_SIDE} a side and "
                f"{_MAX_PIXELS} in all"
            )
        context.options = limit
        context.thread_type = "AUTO"
        bits = _USUAL_BITS if context.format is None else context.format.padded_bits_per_pixel
        beside = frames_beside(path, context.name, width, height, bits)
        context.thread_count = beside if beside < (os.cpu_count() or 1) else 0  # 0: as FFmpeg likes
        yield container, stream


def frames_beside(path: Path, codec: str, width: int, height: int, bits: int) -> int:
    """How many frames, at least one, of so many bits a pixel may be decoded beside one another within the memory."""
    pixels, size = width * height, path.stat().st_size
    frame = max(1, pixels * bits // 8)
    room = max(_BYTES_ALWAYS, _BYTES_PER_BYTE * size)
    room -= _REFERENCES.get(codec, _FEW_REFERENCES) * frame + _CONVERTED_BYTES * pixels
    if room < 0:
        raise FileFormatError(
            f"{path}: found frames of {width} x {height} pixels, {bits} bits each, in a file of {size} bytes, expected "
            f"frames whose decoding takes at most {_BYTES_ALWAYS >> 20} MiB. To convert it: "
            f"ffmpeg -i {path.name} -vf scale=iw/2:ih/2 -pix_fmt yuv420p {path.stem}_half.mp4"
        )
    return max(1, room // frame)


def reason(error: Exception) -> str:
    """An error of FFmpeg's in one line."""
    return " ".join(str(getattr(error, "strerror", None) or error).split())[:120]


def _demuxer(path: Path) -> str:
    """FFmpeg's name of the container that the file's first bytes are of."""
    try:
        checked_size(path, _MAX_BYTES)
        with path.open("rb") as file:
            head = file.read(16)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise FileFormatError(f"{path}: cannot be read ({error})") from error
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return "avi"
    if head[:4] == b"\x1a\x45\xdf\xa3":
        return "matroska"
    if head[4:8] in _MOV_BOXES:
        return "mov"
    if head[:6] in (b"GIF87a", b"GIF89a"):
        return "gif"
    found = f"a {path.suffix} file" if path.suffix else "a file without an ending"
    raise FileFormatError(
        f"{path}: found {found} that begins as no video does, expected AVI, Matroska, MP4, MOV or GIF"
    )
