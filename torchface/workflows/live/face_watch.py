"""What is wrong with a picture, in words: no face, several, too little light."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from torchface.workflows.live.live_frames import planes

_INTERVAL = 3.0  # seconds between two counts of faces
_DARK = 35.0  # mean of the brightest of the colours, of 255
_SPARSE = 8  # pixels


class FaceWatch:
    """Looks at frames as they pass; faces are counted now and then beside them, in a thread.

    Args:
        count: how many faces a picture (3,H,W) shows.
    """

    def __init__(self, count: Callable[..., int]) -> None:
        self._count = count
        self._faces = 1
        self._due = float("-inf")
        self._ever = False
        self._counting: threading.Thread | None = None
        self.words = ""

    def look(self, picture: np.ndarray, seen: bool, now: float) -> None:
        """Updates ``words`` by a frame, uint8 (H,W,3), that shows the face that is followed or none."""
        self._ever |= seen
        if seen and now >= self._due and (self._counting is None or not self._counting.is_alive()):
            self._due = now + _INTERVAL
            self._counting = threading.Thread(target=self._look_for_others, args=(picture,), daemon=True)
            self._counting.start()
        if seen and self._faces > 1:
            self.words = f"{self._faces} faces: one of them is followed, best the only one in the picture"
        elif seen:
            self.words = "Your face is followed"
        elif picture[::_SPARSE, ::_SPARSE].max(2).mean() < _DARK:
            self.words = "Too dark to see a face: put a light before you"
        elif self._ever:
            self.words = "No face: the last expression is held, then relaxes"
        else:
            self.words = "No face yet: sit before the camera and look into it"

    def _look_for_others(self, picture: np.ndarray) -> None:
        self._faces = self._count(planes(picture))
