"""Video files, a few frames at a time, grey or in colour."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError, ValueRangeError
from torchface.io.video.decoding import opencv, opened, short
from torchface.io.video.packets import Packets, read_packets
from torchface.io.video.timing import check_even_rate

_LARGEST_SIDE = 8192
_LARGEST_FRAME = 4096 * 4096
LARGEST_FPS = 10_000.0
_HIDDEN = 16  # frames before the point where an edit list of MP4 says that the video begins


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

    def check(self) -> None:
        """Goes through the file without decoding it, and refuses what no take can be made of.

        ``chunks`` and ``color_chunks`` do so before their first frame.

        Raises:
            FileFormatError: frames change their size on the way, or come at a variable rate.
        """
        self._checked_packets()

    def chunks(self, frames: int = 64) -> Iterator[Tensor]:
        """The frames as uint8 tensors (t,H,W), ``frames`` at a time, the last chunk shorter.

        Raises:
            FileFormatError: the video ends before it should, changes its frames' size, or has a variable frame rate.
        """
        cv2 = opencv()
        for held in self._held(frames):
            grey = [frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) for frame in held]
            yield torch.from_numpy(np.stack(grey))

    def color_chunks(self, frames: int = 16) -> Iterator[Tensor]:
        """The frames in colour as uint8 tensors (t,3,H,W), red first, ``frames`` at a time, the last chunk shorter.

        Raises:
            FileFormatError: the video ends before it should, changes its frames' size, or has a variable frame rate.
        """
        for held in self._held(frames):
            color = [np.repeat(frame[..., None], 3, 2) if frame.ndim == 2 else frame[..., ::-1] for frame in held]
            yield torch.from_numpy(np.ascontiguousarray(np.stack(color).transpose(0, 3, 1, 2)))

    def frames(self) -> Iterator[Tensor]:
        """The frames one by one, uint8 (H,W)."""
        for chunk in self.chunks(16):
            yield from chunk

    def color_frames(self) -> Iterator[Tensor]:
        """The frames in colour one by one, uint8 (3,H,W), red first."""
        for chunk in self.color_chunks(8):
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

    def _held(self, frames: int) -> Iterator[list[np.ndarray]]:
        if frames < 1:
            raise ValueRangeError(f"frames: found {frames}, expected at least 1")
        held: list[np.ndarray] = []
        for frame in self._decoded():
            held.append(frame)
            if len(held) == frames:
                yield held
                held = []
        if held:
            yield held

    def _decoded(self) -> Iterator[np.ndarray]:
        """Frames as OpenCV gives them, (H,W,3) blue first or (H,W)."""
        packets = self._checked_packets()
        cv2, capture = opencv(), opened(self.path)
        found = 0
        try:
            while True:  # a decoder gives one frame at a time
                try:
                    good, frame = capture.read()
                except cv2.error as error:
                    raise FileFormatError(f"{self.path}: frame {found} cannot be decoded ({short(error)})") from error
                if not good:
                    break
                if frame.shape[:2] != (self.height, self.width):
                    raise FileFormatError(
                        f"{self.path}: frame {found} is {frame.shape[1]} x {frame.shape[0]} pixels, "
                        f"expected {self.width} x {self.height} as the first"
                    )
                found += 1
                yield frame
        finally:
            capture.release()
        # Headers count by duration and rate: a frame or two may be missing from a whole file.
        fewest = 0.99 * self.count - 1
        if packets is not None and len(packets.seconds) >= fewest and _has_edit_list(self.path):
            fewest = min(fewest, self.count - _HIDDEN)
        if found < max(fewest, 1):
            raise FileFormatError(
                f"{self.path}: {found} frames could be decoded, expected {self.count} as its header says: "
                "the file is cut off or damaged"
            )

    def _checked_packets(self) -> Packets | None:
        packets = read_packets(self.path)
        if packets is None:
            return None
        resized = packets.resized()
        if resized is not None:
            _, width, height = packets.sizes[0]
            raise FileFormatError(
                f"{self.path}: frame {resized[0]} is {resized[1]} x {resized[2]} pixels, expected {width} x {height} "
                f"as the first. To convert it: ffmpeg -i {self.path.name} -vf scale={width}:{height} "
                f"{self.path.stem}_even.mp4"
            )
        check_even_rate(self.path, packets.seconds, self.fps)
        return packets


def open_video(path: str | Path) -> VideoFile:
    """Opens a video and decodes its first frame, so that one that cannot be decoded is refused at once.

    Args:
        path: an ``.avi``, ``.mkv``, ``.webm``, ``.mp4`` or ``.mov`` file; told by its content.

    Raises:
        FileFormatError: the file is missing, no video, of a codec that is not there, or claims absurd sizes.
    """
    path = Path(path)
    cv2, capture = opencv(), opened(path)
    try:
        fps = capture.get(cv2.CAP_PROP_FPS)
        width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        if not (1 <= width <= _LARGEST_SIDE and 1 <= height <= _LARGEST_SIDE and width * height <= _LARGEST_FRAME):
            raise FileFormatError(
                f"{path}: found frames of {width:.0f} x {height:.0f} pixels, expected at most {_LARGEST_SIDE} a side"
            )
        if not (math.isfinite(fps) and 0 < fps <= LARGEST_FPS):
            raise FileFormatError(f"{path}: found {fps} frames a second, expected a positive number")
        try:
            good, frame = capture.read()
        except cv2.error as error:
            raise FileFormatError(f"{path}: cannot be decoded ({short(error)})") from error
        if not good:
            raise FileFormatError(f"{path}: no frame can be decoded; expected a video of a codec that FFmpeg knows")
        if not 1 <= count < 2**31:
            raise FileFormatError(f"{path}: its header says {count:.0f} frames, expected a positive number")
    finally:
        capture.release()
    return VideoFile(path, fps, frame.shape[1], frame.shape[0], int(count))


def _has_edit_list(path: Path) -> bool:
    """Whether the container is of a kind whose header can hide frames of the file."""
    with path.open("rb") as file:
        return file.read(12)[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free")
