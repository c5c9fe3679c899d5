"""Anybody's finder drives the tracker; one that breaks the protocol is named, with the frame."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks import FaceBoxes, FoundLandmarks, LandmarkTracker, track_landmarks
from torchface.landmarks.images.ibug_68 import box_around, tilt_around
from torchface.landmarks.images.landmark_finder import confidence_of
from torchface.synthetic import performer


@pytest.fixture(scope="module")
def face() -> Tensor:
    """The performer's landmarks from the front, (68,2) pixels, about their mean, the eyes 60 apart."""
    rig = performer()
    points = rig.vertices[rig.neutral.landmarks][:, :2] * torch.tensor([1.0, -1.0])
    points = points - points.mean(0)
    return points * 60 / (points[36] - points[45]).norm()


def turned(points: Tensor, angle: float) -> Tensor:
    cos, sin = math.cos(angle), math.sin(angle)
    return points @ torch.tensor([[cos, sin], [-sin, cos]])


def test_boxes_turn_with_the_face(face: Tensor) -> None:
    upright = box_around(face)
    assert float(tilt_around(face)) == pytest.approx(0, abs=0.02)
    for angle in (0.7, -2.0, math.pi - 0.1):
        found = tilt_around(turned(face, angle)) - tilt_around(face)
        assert math.remainder(float(found) - angle, math.tau) == pytest.approx(0, abs=1e-5)
        box = box_around(turned(face, angle), angle)
        middle, expected = box[:2] + box[2:] / 2, turned((upright[:2] + upright[2:] / 2)[None], angle)[0]
        torch.testing.assert_close(middle, expected, atol=1e-3, rtol=0)
        torch.testing.assert_close(box[2:], upright[2:], atol=1e-3, rtol=0)


class Knowing:
    """Finds a planted face wherever the box is, unless it is more than half a side away."""

    name = "planted"

    def __init__(self, landmarks: Tensor) -> None:
        self.landmarks = landmarks

    def __call__(self, image: Tensor, box: Tensor, tilt: float = 0.0) -> FoundLandmarks:
        at = self.landmarks
        away = (at.mean(0) - box[:2] - box[2:] / 2).norm() / box[2]
        return FoundLandmarks(at, confidence_of(torch.full((68,), 0.01)), torch.ones(68), float(away < 0.5))


def test_a_finder_of_ones_own_is_followed(face: Tensor) -> None:
    finder = Knowing(face + 100)
    tracker = LandmarkTracker(finder, detector=lambda _: FaceBoxes(box_around(face + 104)[None], torch.ones(1)))
    frames = torch.zeros(4, 200, 200, dtype=torch.uint8)
    track = track_landmarks(frames, tracker)
    torch.testing.assert_close(track.values, (face + 100).expand(4, -1, -1))
    torch.testing.assert_close(track.confidence, torch.full((4, 68), 0.8))
    finder.landmarks = face + 400
    assert not tracker.step(frames[0]).found


def test_a_finder_that_breaks_the_protocol_is_named(face: Tensor) -> None:
    frames = torch.zeros(2, 200, 200, dtype=torch.uint8)
    good = Knowing(face + 100)(frames[0], box_around(face + 100))
    cases = [
        (replace(good, landmarks=face[:5]), ShapeError, r"frame 0: .*function: .*\(5, 2\).*expected \(68,2\)"),
        (replace(good, landmarks=face * torch.nan), ValueRangeError, "68 landmarks that are not finite"),
        (
            replace(good, confidence=torch.full((68,), 1.5)),
            ValueRangeError,
            "confidence from 1.5 to 1.5, expected 0 to",
        ),
        (replace(good, visibility=torch.full((68,), torch.nan)), ValueRangeError, "visibility from nan"),
        (replace(good, presence=2.0), ValueRangeError, "presence 2, expected 0 to 1"),
    ]
    for found, kind, message in cases:

        def finder(image: Tensor, box: Tensor, tilt: float = 0.0, found: FoundLandmarks = found) -> FoundLandmarks:
            return found

        tracker = LandmarkTracker(finder, detector=lambda _: FaceBoxes(box_around(face + 100)[None], torch.ones(1)))
        with pytest.raises(kind, match=message):
            track_landmarks(frames, tracker)
