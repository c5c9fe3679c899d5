"""The decoder of video files: which files it is given, and what it says when it fails."""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from torchface.errors import FileFormatError

if TYPE_CHECKING:
    import cv2

_LARGEST_FILE = 2**36


def opened(path: Path) -> cv2.VideoCapture:
    """A decoder on a file that is a video container by its first bytes.

    FFmpeg also knows playlists that name other files and addresses, and OpenCV patterns of file names and device
    numbers: none of them gets there.

    Raises:
        FileFormatError: the file is missing, no video, or of a codec that is not there.
    """
    try:
        if not path.is_file():
            raise FileFormatError(f"{path}: found no such file, expected a video")
        size = path.stat().st_size
        if not 0 < size <= _LARGEST_FILE:
            raise FileFormatError(f"{path}: found {size} bytes, expected 1 to {_LARGEST_FILE}")
        with path.open("rb") as file:
            start = file.read(16)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise FileFormatError(f"{path}: cannot be read ({error})") from error
    if not (
        (start[:4] == b"RIFF" and start[8:12] == b"AVI ")
        or start[:4] == b"\x1a\x45\xdf\xa3"
        or start[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free")
    ):
        raise FileFormatError(f"{path}: found {start[:8]!r} at its start, expected an AVI, Matroska, MP4 or MOV video")
    cv2 = opencv()
    capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise FileFormatError(f"{path}: cannot be opened as a video: cut off, or of a codec that FFmpeg does not know")
    return capture


def opencv() -> ModuleType:
    """OpenCV, silent: it and FFmpeg would print to the terminal; what matters comes as an error."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    import cv2

    return cv2


def short(error: Exception) -> str:
    """An error of OpenCV's in one line."""
    return " ".join(str(error).split())[:120]
