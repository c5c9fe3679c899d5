"""An actor's own rig solved frame by frame: landmarks, where the head is, weights."""

from __future__ import annotations

import numpy as np
import torch

from torchface.capture.anybody import WebcamControls
from torchface.capture.own_rig import VideoState
from torchface.capture.own_rig.landmark_offsets import LandmarkOffsets
from torchface.capture.own_rig.landmark_smoothing import LandmarkFilter
from torchface.errors import ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.distortion import undistort
from torchface.landmarks.images.landmark_finder import trust_of
from torchface.landmarks.images.tracking.landmark_tracker import LandmarkTracker
from torchface.rig import BlendshapeRig
from torchface.workflows.live.live_frames import planes
from torchface.workflows.live.solved_frames import LiveFrame
from torchface.workflows.track.track_inputs import solver_for
from torchface.workflows.track.track_models import TrackModels

_MIN_LANDMARKS = 6


class ActorSolver:
    """Landmarks, pose and weights one frame at a time.

    Args:
        rig: the actor's, with its 68 landmarks.
        models: what tracks and solves.
        calibration: of the camera.
        face: number of the face, the largest first.
        offsets: between the rig's landmarks and those that the models find.
    """

    def __init__(
        self,
        rig: BlendshapeRig,
        models: TrackModels,
        calibration: CameraCalibration,
        face: int = 0,
        offsets: LandmarkOffsets | None = None,
    ) -> None:
        self.names = rig.names
        if models.finder is None:
            raise ValueRangeError("--landmarks: found a table, expected what finds landmarks as the face moves")
        self._tracker = LandmarkTracker(models.finder, models.appearance, face=face)
        self._calibration, self._filter = calibration, LandmarkFilter()
        solver = solver_for(rig, models, calibration)
        self._solver = solver if offsets is None else solver.shifted(offsets)
        self._state: VideoState | None = None

    def step(self, picture: np.ndarray, interval: float | None, controls: WebcamControls) -> LiveFrame:
        """Solves the next frame; before the first face all weights are 0. Of an actor nothing is learned on the way."""
        seen = self._tracker.step(planes(picture))
        trust = trust_of(seen.confidence, seen.visibility)
        # What is hidden is a guess, that a filter would carry on into the frames after.
        shown = torch.where(trust[:, None] > 0, seen.landmarks, torch.nan)
        landmarks = self._filter.step(undistort(shown, self._calibration))
        enough = int((torch.isfinite(landmarks).all(1) & (trust > 0)).sum()) >= _MIN_LANDMARKS
        if self._state is None and not enough:
            return LiveFrame(torch.zeros(len(self.names)), torch.full((3, 3), torch.nan), seen.landmarks)
        before = self._state or self._solver.start()
        self._state = self._solver.step(before, landmarks, confidence=trust, interval=interval)
        weights, rotation = self._state.weights.detach().float(), self._state.rotation.detach().float()
        return LiveFrame(weights, rotation, seen.landmarks)
