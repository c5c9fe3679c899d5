"""A camera at this machine: opened with little delay, watched while it runs."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from torchface.errors import FileFormatError
from torchface.io.video import VideoFile
from torchface.workflows.live.camera_devices import BY_FILE, list_cameras, no_camera

DEFAULT_SIZE = (640, 480)
"""Width and height that suit faces before a webcam."""

_DEFAULT_FPS, _WANTED_FPS = 30.0, 60.0
_MAX_WAIT = 5.0  # seconds without a frame
_FIRST_WAIT = 2.5  # and until the first
_TICK = 0.2  # seconds until an interrupt is looked for
_RETRY = 0.05
_MEASURED = 2.0  # seconds over which the rate is measured
_RATE_CHANGE = 1.4


class Camera:
    """A camera; a thread takes its frames, and the newest one is given.

    It is asked for Motion-JPEG, 60 frames a second and the shortest queue; what it gives instead is taken. Frames of
    another size than the first are fitted into that size.

    Args:
        number: of the device, from 0.
        say: called with a change of size or rate, and why the frames ended.
        size: width and height to ask for.

    Raises:
        FileFormatError: there is none, or it gives no frame within 2.5 seconds.
    """

    def __init__(self, number: int, say: Callable[[str], None], size: tuple[int, int] = DEFAULT_SIZE) -> None:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what matters comes as an error
        self._name, self._say = f"camera {number}", say
        self._capture = cv2.VideoCapture(number)
        if not self._capture.isOpened():
            self._capture.release()
            raise no_camera(number, list_cameras())
        for setting, value in (
            (cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG")),
            (cv2.CAP_PROP_FRAME_WIDTH, size[0]),
            (cv2.CAP_PROP_FRAME_HEIGHT, size[1]),
            (cv2.CAP_PROP_FPS, _WANTED_FPS),
            (cv2.CAP_PROP_BUFFERSIZE, 1),
        ):
            self._capture.set(setting, value)
        self.dropped, self.late, self._begun = 0, 0.0, False
        self._newest: tuple[float, np.ndarray] | None = None
        self._change = threading.Condition()
        self._open = True
        self._size: tuple[int, int] | None = None
        self._thread = threading.Thread(target=self._take, name="torchface-camera", daemon=True)
        self._thread.start()
        with self._change:
            first = self._wait(_FIRST_WAIT)
        if first is None:
            self.close()
            raise FileFormatError(
                f"{self._name}: gives no frame within {_FIRST_WAIT:g} seconds; expected one that no other program "
                f"holds and that is switched on. {BY_FILE}"
            )
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        height, width = first[1].shape[:2]
        self.video = VideoFile(Path(self._name), rate if 1 <= rate <= 1000 else _DEFAULT_FPS, width, height, 1)

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        """When each frame came, and the frame, uint8 (H,W,3), red first; until the camera gives no more."""
        self._begun = True
        while True:
            with self._change:
                newest = self._wait()
                self._newest = None
            if newest is None:
                self._say(f"{self._name} gave no frame for {_MAX_WAIT:.0f} seconds: is it still plugged in?")
                return
            came, frame = newest
            yield came, cv2.cvtColor(self._fitted(frame), cv2.COLOR_BGR2RGB)

    def close(self) -> None:
        """Gives the camera back."""
        self._open = False
        self._thread.join(_MAX_WAIT)
        if not self._thread.is_alive():  # one that hangs in its driver cannot be released
            self._capture.release()

    def _wait(self, seconds: float = _MAX_WAIT) -> tuple[float, np.ndarray] | None:
        end = time.monotonic() + seconds
        while self._newest is None and self._open and time.monotonic() < end:
            self._change.wait(_TICK)
        return self._newest

    def _take(self) -> None:
        failed: float | None = None
        pace = _Pace()
        while self._open:
            good, frame = self._capture.read()
            now = time.perf_counter()
            if not good or frame is None:
                failed = failed or now
                if now - failed > _MAX_WAIT:
                    break
                time.sleep(_RETRY)
                continue
            failed = None
            change = pace.changed(now)
            if change is not None:
                self._say(f"{self._name} now gives {change[1]:.0f} frames a second ({change[0]:.0f} before)")
            with self._change:
                self.dropped += self._begun and self._newest is not None
                self._newest = (now, frame)
                self._change.notify()
        with self._change:
            self._open = False
            self._change.notify()

    def _fitted(self, frame: np.ndarray) -> np.ndarray:
        """A frame in the size of the first, its aspect kept."""
        width, height = self.video.width, self.video.height
        size = (frame.shape[1], frame.shape[0])
        if size != (self._size or (width, height)):
            self._say(
                f"{self._name} changed its pictures to {size[0]} x {size[1]} pixels; fitted into {width} x {height}"
            )
        self._size = size
        if size == (width, height):
            return frame
        scale = min(width / size[0], height / size[1])
        inside = (max(1, round(scale * size[0])), max(1, round(scale * size[1])))
        left, top = (width - inside[0]) // 2, (height - inside[1]) // 2
        fitted = np.zeros((height, width, 3), np.uint8)
        fitted[top : top + inside[1], left : left + inside[0]] = cv2.resize(frame, inside, interpolation=cv2.INTER_AREA)
        return fitted


class _Pace:
    """Notices when frames come markedly faster or slower than they did."""

    def __init__(self) -> None:
        self._told: float | None = None  # measured: what a camera says of its rate is often wrong
        self._since: float | None = None
        self._count = 0

    def changed(self, came: float) -> tuple[float, float] | None:
        """The rate before and now, if it changed with this frame."""
        if self._since is None:
            self._since = came
            return None
        self._count += 1
        if came - self._since < _MEASURED:
            return None
        rate, before = self._count / (came - self._since), self._told
        self._since, self._count = came, 0
        if before is not None and max(rate / before, before / rate) < _RATE_CHANGE:
            return None
        self._told = rate
        return None if before is None else (before, rate)
