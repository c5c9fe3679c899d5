"""An actor's own rig solved frame by frame: landmarks, where the head is, weights."""

from __future__ import annotations

import numpy as np
import torch

from torchface.capture.anybody import WebcamControls
from torchface.capture.own_rig import VideoState
from torchface.capture.own_rig.landmark_offsets import LandmarkOffsets
from torchface.errors import ValueRangeError
from torchface.geometry.cameras.distortion import undistort
from torchface.landmarks.images.tracking.landmark_tracker import LandmarkTracker
from torchface.temporal.adaptive_kalman import LANDMARK_SETTINGS, AdaptiveFilter
from torchface.workflows.live.live_frames import planes
from torchface.workflows.live.solved_frames import LiveFrame
from torchface.workflows.track.track_inputs import TrackInputs

_MIN_LANDMARKS = 6


class ActorSolver:
    """Landmarks, pose and weights one frame at a time.

    Args:
        inputs: of the camera.
        offsets: between the rig's landmarks and those that the models find.
    """

    def __init__(self, inputs: TrackInputs, offsets: LandmarkOffsets | None = None) -> None:
        self.names, models = inputs.actor.names, inputs.models
        if models.finder is None:
            raise ValueRangeError("--landmarks: found a table, expected what finds landmarks as the face moves")
        self._tracker = LandmarkTracker(models.finder, models.appearance, face=inputs.settings.face)
        self._calibration, self._filter = inputs.calibration, AdaptiveFilter(68, 2, LANDMARK_SETTINGS)
        solver = inputs.solver()
        self._solver = solver if offsets is None else solver.shifted(offsets)
        self._state: VideoState | None = None

    def step(self, picture: np.ndarray, interval: float | None, controls: WebcamControls) -> LiveFrame:
        """Solves the next frame; before the first face all weights are 0. Of an actor nothing is learned on the way."""
        reading = self._tracker.step(planes(picture))
        trust = reading.trust
        landmarks = self._filter.step(undistort(reading.trusted_landmarks, self._calibration)).to(reading.landmarks)
        enough = int((torch.isfinite(landmarks).all(1) & (trust > 0)).sum()) >= _MIN_LANDMARKS
        if self._state is None and not enough:
            return LiveFrame(torch.zeros(len(self.names)), torch.full((3, 3), torch.nan), reading.landmarks)
        before = self._state or self._solver.start()
        self._state = self._solver.step(before, landmarks, confidence=trust, interval=interval)
        weights, rotation = self._state.weights.detach().float(), self._state.rotation.detach().float()
        return LiveFrame(weights, rotation, reading.landmarks)
