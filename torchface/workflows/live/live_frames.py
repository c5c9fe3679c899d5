"""Frames in real time: from a camera at this machine, or from a video played at its own rate."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.io.video import VideoFile, open_video

_DEFAULT_FPS = 30.0
_MAX_WAIT = 5.0


class PlayedVideo:
    """A video file whose frames come at its own rate, as a camera's would; those that come too early are dropped.

    Args:
        path: of the file.

    Raises:
        FileFormatError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.video: VideoFile = open_video(path)
        self.dropped = 0

    def frames(self) -> Iterator[tuple[float, Tensor]]:
        """When each frame was due, and the frame, uint8 (3,H,W)."""
        started = time.perf_counter()
        for number, frame in enumerate(self.video.color_frames()):
            due = started + number / self.video.fps
            early = due - time.perf_counter()
            if early > 0:
                time.sleep(early)
            elif -early > 1 / self.video.fps:  # a camera would have shown the next one by now
                self.dropped += 1
                continue
            yield due, frame

    def __enter__(self) -> PlayedVideo:
        return self

    def __exit__(self, *error: object) -> None:
        return None


class Camera:
    """A camera at this machine; a thread takes its frames, and the newest one is given.

    Args:
        number: of the device, from 0.

    Raises:
        FileFormatError: there is none, or it gives no image.
    """

    def __init__(self, number: int) -> None:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what matters comes as an error
        self._capture = cv2.VideoCapture(number)
        good, frame = self._capture.read() if self._capture.isOpened() else (False, None)
        if not good or frame is None:
            self._capture.release()
            raise FileFormatError(f"camera {number}: cannot be opened, expected the number of a device, from 0")
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        height, width = frame.shape[:2]
        self.video = VideoFile(Path(f"camera {number}"), rate if 1 <= rate <= 1000 else _DEFAULT_FPS, width, height, 1)
        self.dropped = 0
        self._newest: tuple[float, object] | None = None
        self._change = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._take, daemon=True)
        self._thread.start()

    def frames(self) -> Iterator[tuple[float, Tensor]]:
        """When each frame came, and the frame, uint8 (3,H,W); until the camera gives no more."""
        while True:
            with self._change:
                self._change.wait_for(lambda: self._newest is not None or not self._open, _MAX_WAIT)
                newest, self._newest = self._newest, None
            if newest is None:
                return
            came, frame = newest
            pixels = torch.from_numpy(frame)  # type: ignore[arg-type]
            yield came, pixels.flip(-1).permute(2, 0, 1).contiguous()

    def _take(self) -> None:
        while self._open:
            good, frame = self._capture.read()
            with self._change:
                if not good:
                    self._open = False
                else:
                    self.dropped += self._newest is not None
                    self._newest = (time.perf_counter(), frame)
                self._change.notify()

    def __enter__(self) -> Camera:
        return self

    def __exit__(self, *error: object) -> None:
        self._open = False
        self._thread.join(_MAX_WAIT)
        self._capture.release()
