"""Crops of eyes: of any face in the plane the same, the left eye in a mirror, and back again."""

import math

import pytest
import torch

from torchface.errors import ShapeError
from torchface.landmarks.images.face_crop import cut_crops
from torchface.landmarks.images.ibug_68 import MIRROR_68
from torchface.landmarks.images.networks.eye_crop import (
    CROP_HEIGHT,
    CROP_WIDTH,
    EYE_LANDMARKS,
    eye_transforms,
    moved,
    picture_transforms,
)
from train.rendered_people.head_kind import performer_kind


@pytest.fixture(scope="module")
def face() -> torch.Tensor:
    """Landmarks (68,2) of the performer from the front, millimetres with y down."""
    kind = performer_kind()
    marks = kind.draw(torch.Generator().manual_seed(0)).rest[kind.landmarks][:, :2] * torch.tensor([1.0, -1.0])
    return (marks + marks[list(MIRROR_68)] * torch.tensor([-1.0, 1.0])) / 2


def test_crops_do_not_depend_on_where_how_large_and_how_turned_a_face_is(face: torch.Tensor) -> None:
    here = moved(face[list(EYE_LANDMARKS[0])], eye_transforms(face)[0])
    # An eye fills somewhat more than half of its crop, and its corners lie about the middle.
    assert 0.45 * CROP_WIDTH < float(here[3, 0] - here[0, 0]) < 0.65 * CROP_WIDTH
    torch.testing.assert_close(
        (here[0] + here[3]) / 2, torch.tensor([(CROP_WIDTH - 1) / 2, (CROP_HEIGHT - 1) / 2]), atol=1e-3, rtol=0
    )
    for angle, scale, shift in ((0.7, 0.3, (5.0, -9.0)), (-3.0, 4.0, (400.0, 70.0))):
        turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        there = scale * face @ turn.T + torch.tensor(shift)
        transforms = eye_transforms(there[None])[0]
        for row, rows in enumerate(EYE_LANDMARKS):  # the left eye is the right one's mirror image
            torch.testing.assert_close(moved(there[list(rows)], transforms[row]), here, atol=2e-3, rtol=0)


def test_the_way_back_is_the_inverse(face: torch.Tensor) -> None:
    transforms = eye_transforms(3 * face + torch.tensor([50.0, 20.0]))
    points = torch.rand(2, 5, 2) * 40
    torch.testing.assert_close(moved(moved(points, picture_transforms(transforms)), transforms), points)


def test_cut_eyes_show_what_lies_there(face: torch.Tensor) -> None:
    landmarks = 2 * face + torch.tensor([150.0, 150.0])
    image = torch.zeros(3, 300, 300, dtype=torch.uint8)
    for number, row in enumerate((36, 45)):  # a bright spot on each outer corner
        x, y = landmarks[row].round().long().tolist()
        image[number, y - 1 : y + 2, x - 1 : x + 2] = 255
    transforms = eye_transforms(landmarks)
    crops = cut_crops(image, transforms, 48, 32)
    assert crops.shape == (2, 3, CROP_HEIGHT, CROP_WIDTH)
    corners = moved(landmarks[[36, 45]][:, None], transforms)[:, 0]
    for number, crop in enumerate(crops):
        row, column = divmod(int(crop[number].argmax()), CROP_WIDTH)
        assert float((torch.tensor([float(column), float(row)]) - corners[number]).norm()) < 1.5
        assert int(crop[1 - number].max()) == 0
    assert float(corners[:, 0].max()) < CROP_WIDTH / 2  # outer corners lie to the left in both


def test_other_landmarks_are_refused() -> None:
    with pytest.raises(ShapeError, match="expected"):
        eye_transforms(torch.zeros(67, 2))
