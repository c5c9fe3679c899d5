"""Tests of torchface.workflows.live.live_actor."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from torchface.capture.anybody import WebcamControls
from torchface.capture.own_rig.eye_geometry import CORNERS, Eyeballs
from torchface.io.video.blank_video import BlankVideo
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.tracking.landmark_tracker import LandmarkTracker
from torchface.synthetic import performer
from torchface.workflows.live import live_actor
from torchface.workflows.live.live_actor import ActorSolver
from torchface.workflows.track.track_inputs import TrackSettings, inputs_of

PLACE = torch.tensor([0.0, 0.0, 500.0]).double()


def projected(points: Tensor, intrinsics: Tensor) -> Tensor:
    """Pixels (...,2) of points (...,3) of a head that faces the camera at ``PLACE``."""
    seen = (points * torch.tensor([1.0, -1.0, -1.0]) + PLACE) @ intrinsics.double().T
    return (seen[..., :2] / seen[..., 2:]).float()


def test_eyes_look_where_irises_are_and_shut(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, picture = performer(texture=False), np.zeros((480, 640, 3), np.uint8)
    inputs = inputs_of(BlankVideo(Path("eyes"), 30.0, 640, 480, 40), rig, TrackSettings())
    rest, eyeballs = rig.vertices[rig.neutral.landmarks].double(), Eyeballs.of(rig)
    centres = torch.stack([0.5 * (rest[a] + rest[b]) for a, b in CORNERS]) + eyeballs.centre
    intrinsics, ones = inputs.calibration.intrinsics, torch.ones(2)

    def reading(left: float, shut: float) -> FaceReading:
        ray = torch.tensor([left, 0.0, 1.0]).double()
        iris = projected(centres + eyeballs.radius[:, None] * ray / ray.norm(), intrinsics)
        open_, sure = (0.3 - 0.27 * shut) * ones, torch.ones(68)
        return FaceReading(projected(rest, intrinsics), sure, sure, sure[0], iris, open_, shut * ones, ones)

    shown = [reading(0.0, 0.0)] * 20 + [reading(0.3, 0.0)] * 10 + [reading(0.0, 0.99)] * 5
    pictures = iter(shown)
    monkeypatch.setattr(live_actor, "graph_detector", lambda: None)
    monkeypatch.setattr(LandmarkTracker, "step", lambda tracker, frame: next(pictures))
    solver = ActorSolver(inputs)
    solved = torch.stack([torch.as_tensor(solver.step(picture, 1 / 30, WebcamControls()).weights) for _ in shown])
    named = {name: solved[:, solver.names.index(name)] for name in solver.names if name.startswith("eye")}
    aside = named["eyeLookOutLeft"], named["eyeLookInRight"]
    turned = torch.atan(torch.tensor(0.3)) / eyeballs.turns[[1, 2]].mean()
    for look in aside:
        assert look[:20].max() < 0.1
        assert abs(look[29] - turned) < 0.12
    assert named["eyeLookInLeft"].max() < 0.1
    blinks = torch.stack([named["eyeBlinkLeft"], named["eyeBlinkRight"]])
    assert blinks[:, :30].max() < 0.3
    assert blinks[:, -1].min() > 0.7
    hidden = replace(reading(0.3, 0.0), eye_visibility=0 * ones)
    monkeypatch.setattr(LandmarkTracker, "step", lambda tracker, frame: hidden)
    assert ActorSolver(inputs).step(picture, 1 / 30, WebcamControls()).weights.isfinite().all()
