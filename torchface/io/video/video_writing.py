"""Writing video files, grey or in colour."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.io.video.decoding import opencv
from torchface.io.video.video_file import LARGEST_FPS, VideoFile

_CODECS = {".avi": "FFV1", ".mkv": "FFV1", ".mp4": "mp4v"}


def write_video(frames: Iterable[Tensor], path: str | Path, fps: float) -> VideoFile:
    """Writes frames; the file appears only when it is complete.

    Args:
        frames: grey chunks (t,H,W) or single grey frames (H,W), or chunks in colour (t,3,H,W), red first; uint8, or
            floats in [0,1]; all of one size, all grey or all in colour. Three dimensions are always grey: a single
            frame in colour is (1,3,H,W).
        path: ``.avi`` and ``.mkv`` are lossless (FFV1), ``.mp4`` (MPEG-4) is not.
        fps: frames a second.

    Raises:
        FileFormatError: another ending, or the file cannot be written.
        ShapeError: no frames, frames that differ in size, or grey ones among those in colour.
        ValueRangeError: ``fps`` is not a positive number.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _CODECS:
        raise FileFormatError(f"{path}: found the ending {path.suffix!r}, expected {', '.join(_CODECS)}")
    if not (math.isfinite(fps) and 0 < fps <= LARGEST_FPS):
        raise ValueRangeError(f"fps: found {fps}, expected a positive number")
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{suffix}")
    cv2 = opencv()
    writer, count = None, 0
    shape: tuple[int, ...] = (0, 0)
    try:
        for frame in _single(frames):  # the encoder takes one frame at a time
            height, width = frame.shape[-2:]
            if writer is None:
                shape = tuple(frame.shape)
                code = cv2.VideoWriter.fourcc(*_CODECS[suffix])
                colored = frame.ndim == 3
                writer = cv2.VideoWriter(str(temporary), cv2.CAP_FFMPEG, code, fps, (width, height), isColor=colored)
                if not writer.isOpened():
                    raise FileFormatError(f"{path}: cannot be written as {_CODECS[suffix]}, {width} x {height}")
            if frame.shape != shape:
                raise ShapeError(f"frames: found {tuple(frame.shape)}, expected {shape} as the first")
            pixels = to_bytes(frame).numpy()
            if pixels.ndim == 3:
                pixels = np.ascontiguousarray(pixels[::-1].transpose(1, 2, 0))
            writer.write(pixels)
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
    return VideoFile(path, fps, shape[-1], shape[-2], count)


def to_bytes(frame: Tensor) -> Tensor:
    """Grey or colour values as uint8, of the same shape; floats are in [0,1]."""
    if frame.dtype == torch.uint8:
        return frame.contiguous()
    return (frame.clamp(0, 1) * 255).round().to(torch.uint8).contiguous()


def _single(frames: Iterable[Tensor]) -> Iterator[Tensor]:
    """Frames (H,W) or (3,H,W) one by one."""
    for chunk in frames:
        if chunk.ndim not in (2, 3, 4) or (chunk.ndim == 4 and chunk.shape[1] != 3):
            raise ShapeError(f"frames: found {tuple(chunk.shape)}, expected (H,W), (t,H,W), or (t,3,H,W) in colour")
        yield from chunk if chunk.ndim > 2 else chunk[None]
