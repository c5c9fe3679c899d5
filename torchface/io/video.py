"""Grey video files, a few frames at a time."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError, ValueRangeError

if TYPE_CHECKING:
    import cv2

_LARGEST_SIDE = 8192
_LARGEST_FRAME = 4096 * 4096
_LARGEST_FPS = 10_000.0
_LARGEST_FILE = 2**36
_CODECS = {".avi": "FFV1", ".mkv": "FFV1", ".mp4": "mp4v"}


@dataclass(frozen=True)
class VideoFile:
    """What a video's header says, and the way to its frames.

    Args:
        path: the file.
        fps: frames a second.
        width, height: pixels.
        count: how many frames the file says it has; the frames themselves are counted as they are read.
    """

    path: Path
    fps: float
    width: int
    height: int
    count: int

    @property
    def seconds(self) -> float:
        """How long it says it is."""
        return self.count / self.fps

    def chunks(self, frames: int = 64) -> Iterator[Tensor]:
        """The frames as uint8 tensors (t,H,W), ``frames`` at a time, the last chunk shorter.

        Raises:
            FileFormatError: the video ends before it should, or a frame has another size than the header says.
        """
        if frames < 1:
            raise ValueRangeError(f"frames: found {frames}, expected at least 1")
        cv2, capture = _opencv(), _opened(self.path)
        found = 0
        try:
            held: list[Tensor] = []
            while True:  # a decoder gives one frame at a time
                try:
                    good, frame = capture.read()
                except cv2.error as error:
                    raise FileFormatError(f"{self.path}: frame {found} cannot be decoded ({_short(error)})") from error
                if not good:
                    break
                if frame.shape[:2] != (self.height, self.width):
                    raise FileFormatError(
                        f"{self.path}: frame {found} is {frame.shape[1]} x {frame.shape[0]} pixels, "
                        f"expected {self.width} x {self.height} as the first"
                    )
                grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
                held.append(torch.from_numpy(grey.copy()))
                found += 1
                if len(held) == frames:
                    yield torch.stack(held)
                    held = []
            if held:
                yield torch.stack(held)
        finally:
            capture.release()
        # Headers count by duration and rate: a frame or two may be missing from a whole file.
        if found < 0.99 * self.count - 1:
            raise FileFormatError(
                f"{self.path}: {found} frames could be decoded, expected {self.count} as its header says: "
                "the file is cut off or damaged"
            )

    def frames(self) -> Iterator[Tensor]:
        """The frames one by one, uint8 (H,W)."""
        for chunk in self.chunks(16):
            yield from chunk

    def frame(self, number: int) -> Tensor:
        """One frame, uint8 (H,W).

        Raises:
            ValueRangeError: the video is shorter.
        """
        if not 0 <= number < self.count:
            raise ValueRangeError(f"{self.path}: asked for frame {number}, found {self.count} frames")
        for i, frame in enumerate(self.frames()):  # codecs seek wrongly too often to jump there
            if i == number:
                return frame
        raise ValueRangeError(f"{self.path}: asked for frame {number}, found fewer")


def open_video(path: str | Path) -> VideoFile:
    """Opens a video and decodes its first frame, so that one that cannot be decoded is refused at once.

    Args:
        path: an ``.avi``, ``.mkv``, ``.webm``, ``.mp4`` or ``.mov`` file; told by its content.

    Raises:
        FileFormatError: the file is missing, no video, of a codec that is not there, or claims absurd sizes.
    """
    path = Path(path)
    cv2, capture = _opencv(), _opened(path)
    try:
        fps = capture.get(cv2.CAP_PROP_FPS)
        width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        if not (1 <= width <= _LARGEST_SIDE and 1 <= height <= _LARGEST_SIDE and width * height <= _LARGEST_FRAME):
            raise FileFormatError(
                f"{path}: found frames of {width:.0f} x {height:.0f} pixels, expected at most {_LARGEST_SIDE} a side"
            )
        if not (math.isfinite(fps) and 0 < fps <= _LARGEST_FPS):
            raise FileFormatError(f"{path}: found {fps} frames a second, expected a positive number")
        try:
            good, frame = capture.read()
        except cv2.error as error:
            raise FileFormatError(f"{path}: cannot be decoded ({_short(error)})") from error
        if not good:
            raise FileFormatError(f"{path}: no frame can be decoded; expected a video of a codec that FFmpeg knows")
        if not 1 <= count < 2**31:
            raise FileFormatError(f"{path}: its header says {count:.0f} frames, expected a positive number")
    finally:
        capture.release()
    return VideoFile(path, fps, frame.shape[1], frame.shape[0], int(count))


def write_video(frames: Iterable[Tensor], path: str | Path, fps: float) -> VideoFile:
    """Writes grey frames; the file appears only when it is complete.

    Args:
        frames: chunks (t,H,W) or single frames (H,W), uint8, or floats in [0,1]; all of one size.
        path: ``.avi`` and ``.mkv`` are lossless (FFV1), ``.mp4`` is not.
        fps: frames a second.

    Raises:
        FileFormatError: another ending, or the file cannot be written.
        ShapeError: no frames, or frames that differ in size.
        ValueRangeError: ``fps`` is not a positive number.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _CODECS:
        raise FileFormatError(f"{path}: found the ending {path.suffix!r}, expected {', '.join(_CODECS)}")
    if not (math.isfinite(fps) and 0 < fps <= _LARGEST_FPS):
        raise ValueRangeError(f"fps: found {fps}, expected a positive number")
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{suffix}")
    cv2 = _opencv()
    writer, size, count = None, (0, 0), 0
    try:
        for chunk in frames:  # the encoder takes one frame at a time
            for frame in chunk if chunk.ndim == 3 else chunk[None]:
                if writer is None:
                    size = (int(frame.shape[1]), int(frame.shape[0]))
                    code = cv2.VideoWriter.fourcc(*_CODECS[suffix])
                    writer = cv2.VideoWriter(str(temporary), cv2.CAP_FFMPEG, code, fps, size, isColor=False)
                    if not writer.isOpened():
                        raise FileFormatError(f"{path}: cannot be written as {_CODECS[suffix]}, {size[0]} x {size[1]}")
                if (frame.shape[1], frame.shape[0]) != size:
                    raise ShapeError(f"frames: found {tuple(frame.shape)}, expected {size[::-1]} as the first")
                writer.write(to_bytes(frame).numpy())
                count += 1
        if writer is None:
            raise ShapeError(f"{path}: found no frame, expected at least one")
        writer.release()
        os.replace(temporary, path)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        if writer is not None:
            writer.release()
        temporary.unlink(missing_ok=True)
    return VideoFile(path, fps, size[0], size[1], count)


def to_bytes(frame: Tensor) -> Tensor:
    """Grey values as uint8, of the same shape; floats are in [0,1]."""
    if frame.dtype == torch.uint8:
        return frame.contiguous()
    return (frame.clamp(0, 1) * 255).round().to(torch.uint8).contiguous()


def _opened(path: Path) -> cv2.VideoCapture:
    """A decoder on a file that is a video container by its first bytes.

    FFmpeg also knows playlists that name other files and addresses, and OpenCV patterns of file names and device
    numbers: none of them gets there.
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
    cv2 = _opencv()
    capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise FileFormatError(f"{path}: cannot be opened as a video; expected a codec that FFmpeg knows")
    return capture


def _opencv() -> ModuleType:
    """OpenCV, silent: it and FFmpeg would print to the terminal; what matters comes as an error."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    import cv2

    return cv2


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:120]
