"""Boxes that show no face go; those that do fit the landmarks, at every roll angle."""

import math

import pytest
import torch
from torch import Tensor

from torchface import zoo
from torchface.geometry.cameras.pinhole import look_at
from torchface.landmarks.images.boxes.face_box import FaceBoxes, overlaps
from torchface.landmarks.images.checked_detector import CheckedDetector, shipped_detector
from torchface.landmarks.images.face_crop import cut_crop
from torchface.landmarks.images.ibug_68 import turned_box
from torchface.rendering.clay_shading import Lighting, render
from torchface.synthetic import performer


@pytest.fixture(scope="module")
def portrait() -> tuple[Tensor, Tensor]:
    """A performer's head on grey, (3,200,200), and its landmarks (68,2)."""
    rig = performer()
    marks = rig.neutral.landmarks
    camera = look_at(rig.vertices[marks].double().mean(0), 0.0, 0.0, 440.0, 200, 200)
    picture = render(rig.neutral, camera, background=(0.3, 0.35, 0.4), lighting=Lighting(occlusion_rays=0), samples=1)
    return (picture.clamp(0, 1) * 255).byte(), camera.project(rig.vertices[marks].double()).float()


def turned(portrait: tuple[Tensor, Tensor], angle: float) -> tuple[Tensor, Tensor, Tensor]:
    """The picture turned clockwise about its middle, and the face's box (4,) and tilt."""
    picture, marks = portrait
    cos, sin = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
    middle = torch.full((2,), 99.5, dtype=torch.float64)
    way = torch.cat([turn, (middle - turn @ middle)[:, None]], 1)
    box, tilt = turned_box((marks.double() - middle) @ turn.T.double() + middle)
    return cut_crop(picture, way, 200), box.float(), tilt.float()


def test_loose_boxes_become_those_of_the_landmarks_and_others_go(portrait: tuple[Tensor, Tensor]) -> None:
    picture, box, tilt = turned(portrait, 0.6)
    side = float(box[2])
    loose = box + side * torch.tensor([0.1, -0.08, 0.1, 0.1])
    wall = torch.tensor([2.0, 2.0, 30.0, 30.0])
    proposed = FaceBoxes(
        torch.stack([loose, box, wall]), torch.tensor([0.9, 0.5, 0.7]), tilt + torch.tensor([0.2, 0, 0])
    )
    found = CheckedDetector(lambda _: proposed, zoo.get_model("landmark_network"))(picture)
    assert len(found) == 1
    assert float(overlaps(found.boxes, box[None])) > 0.85
    assert abs(math.remainder(float(found.tilts - tilt), 2 * math.pi)) < 0.08


def test_the_shipped_one_finds_a_face_at_every_roll_angle(portrait: tuple[Tensor, Tensor]) -> None:
    for degrees in range(0, 360, 45):
        picture, box, tilt = turned(portrait, math.radians(degrees))
        found = shipped_detector()(picture)
        assert len(found) == 1, degrees
        assert float(overlaps(found.boxes, box[None])) > 0.8, degrees
        assert abs(math.remainder(float(found.tilts - tilt), 2 * math.pi)) < 0.1, degrees


def test_where_nothing_is_proposed_nothing_is_found() -> None:
    nothing = FaceBoxes(torch.zeros(0, 4), torch.zeros(0))
    found = CheckedDetector(lambda _: nothing, zoo.get_model("landmark_network"))(torch.zeros(3, 80, 80).byte())
    assert found.boxes.shape == (0, 4)
    assert found.tilts.shape == (0,)
