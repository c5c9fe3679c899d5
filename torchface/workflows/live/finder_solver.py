"""Solver of anybody's frames for landmarks that a finder by name finds, in place of the webcam's graph."""

import numpy as np
import torch

from torchface.capture.anybody import WebcamControls
from torchface.landmarks.images.tracking.landmark_tracker import LandmarkTracker
from torchface.progress import Progress, silent
from torchface.shape_names import ARKIT
from torchface.workflows.live.live_frames import LiveFrame, planes
from torchface.workflows.named_finders import graph_detector, load_finder
from torchface.workflows.webcam.webcam_graph import skin_follower, webcam_solver

_USUAL = 1 / 30  # seconds


class FinderSolver:
    """Solves frames for ARKit's weights, as ``WebcamSolver`` does, from what a tracker reads by a finder
    (``load_finder``)."""

    names = ARKIT

    def __init__(self, landmarks: str, progress: Progress = silent) -> None:
        progress(f"reading {landmarks}")
        named = load_finder(landmarks)
        self._tracker = LandmarkTracker(named.finder, detector=graph_detector())
        self._solver = webcam_solver(named.expects)
        self._state = self._solver.start()
        self._skin = skin_follower()

    def step(self, picture: np.ndarray, interval: float | None, controls: WebcamControls) -> LiveFrame:
        """Solves the next frame; see :class:`torchface.workflows.live.live_frames.FaceSolver`."""
        height, width = picture.shape[:2]
        reading = self._tracker.step(planes(picture))
        interval = interval or _USUAL
        self._state = state = self._solver.step(self._state, reading, interval, controls, (width, height))
        ever = bool(state.rotation.any())
        rotation = state.rotation if ever else torch.full((3, 3), torch.nan)
        return LiveFrame(
            self._skin.followed(picture, state, interval, controls),
            rotation,
            reading.landmarks,
            reading.iris,
            state.gaze,
            float(state.calibrated),
            beside=self._tracker.beside,
        )
