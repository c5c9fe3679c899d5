"""View of a live session: one moment as the page shows it, and its bytes."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from torchface.errors import ValueRangeError
from torchface.workflows.live.live_frames import LiveFrame

FRAME, PICTURE = 1, 2
"""First number of a message."""

ROW = 66
"""Numbers of a take's frame: seconds, weights, rotation, gaze."""

_LARGEST_TAKE = 2**26  # bytes; an hour at 60 frames a second
_WIDTH, _QUALITY = 320, 70  # of the camera's small picture


@dataclass(frozen=True, eq=False)
class LiveView:
    """One moment of a live session."""

    came: float  # when the frame came, seconds
    interval: float  # since the frame before, seconds
    latency: float  # from its arrival to its packets on the way, milliseconds
    picture: np.ndarray  # of the camera, uint8 (H,W,3), red first; without pixels of what has none
    solved: LiveFrame

    def message(self) -> bytes:
        """For ``export/web/src/server_engine.js``: kind and 0, milliseconds as a double, then floats."""
        solved = self.solved
        height, width = self.picture.shape[:2]
        facts = [float(solved.seen), solved.calibrated, self.interval, self.latency, float(width), float(height)]
        parts = [solved.weights, solved.rotation, solved.gaze, solved.landmarks, solved.iris, solved.beside]
        numbers = torch.cat([part.detach().cpu().float().reshape(-1) for part in (*parts, torch.tensor(facts))])
        head = np.array([FRAME, 0], "<u4").tobytes() + np.array([1000 * self.came], "<f8").tobytes()
        return head + numbers.numpy().astype("<f4").tobytes()

    def picture_message(self) -> bytes:
        """Kind and 0, then a JPEG of the camera's picture, made small."""
        height, width = self.picture.shape[:2]
        size = (_WIDTH, max(1, round(height * _WIDTH / width)))
        small = self.picture if width <= _WIDTH else cv2.resize(self.picture, size, interpolation=cv2.INTER_AREA)
        coded = cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
        return np.array([PICTURE, 0], "<u4").tobytes() + coded.tobytes()


class TakeUpload:
    """A take of ``size`` bytes that a page hands over in parts; its name is for people."""

    def __init__(self, name: str, size: object) -> None:
        if not isinstance(size, int) or not 0 < size <= _LARGEST_TAKE or size % (4 * ROW):
            raise ValueRangeError(f"page: found a take of {size!r:.20} bytes, expected rows, at most {_LARGEST_TAKE}")
        self.name, self._size, self._data = name, size, bytearray()

    def is_whole_with(self, part: bytes) -> bool:
        """Takes a part; whether it was the last."""
        self._data += part[: self._size - len(self._data)]
        return len(self._data) == self._size

    def rows(self) -> np.ndarray:
        """The rows (T,66), see :func:`torchface.workflows.live.kept_takes.take_rows`."""
        return np.frombuffer(self._data, "<f4").reshape(-1, ROW)
