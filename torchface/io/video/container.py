"""Video containers: which files are opened, as what, and how large their frames may be."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import av
from av.container import InputContainer
from av.video.stream import VideoStream

from torchface.errors import FileFormatError

_MAX_BYTES = 2**36
_MAX_SIDE = 8192
_MAX_PIXELS = 4096 * 4096
_MOV_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")


@contextmanager
def open_container(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """The container of a file and its video stream, ready to be decoded.

    FFmpeg would also follow playlists that name other files and addresses: the demuxer is named here, by the file's
    first bytes. No frame of more than 4096 x 4096 pixels is decoded.

    Raises:
        FileFormatError: the file is missing, no video, of a codec that is not there, or of absurd size.
    """
    demuxer = _demuxer(path)
    limit = {"max_pixels": str(_MAX_PIXELS)}
    try:
        container = av.open(str(path.resolve()), "r", format=demuxer, options=limit, metadata_errors="replace")
    except (av.FFmpegError, ValueError) as error:
        raise FileFormatError(f"{path}: cannot be opened as a video: cut off or damaged ({reason(error)})") from error
    with container:
        stream = container.streams.best("video")
        if not isinstance(stream, VideoStream) or stream.codec_context is None:
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
        yield container, stream


def reason(error: Exception) -> str:
    """An error of FFmpeg's in one line."""
    return " ".join(str(getattr(error, "strerror", None) or error).split())[:120]


def _demuxer(path: Path) -> str:
    """FFmpeg's name of the container that the file's first bytes are of."""
    try:
        if not path.is_file():
            raise FileFormatError(f"{path}: found no such file, expected a video")
        size = path.stat().st_size
        if not 0 < size <= _MAX_BYTES:
            raise FileFormatError(f"{path}: found {size} bytes, expected 1 to {_MAX_BYTES}")
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
    raise FileFormatError(f"{path}: found {head[:8]!r} at its start, expected an AVI, Matroska, MP4 or MOV video")
