"""Faces are found where they are, and only there."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.geometry.cameras.pinhole import look_at
from torchface.io import load_image
from torchface.io.landmarks.dlib_xml import load_dlib_faces
from torchface.io.video import open_video
from torchface.landmarks import FaceBoxes, NoFaceError, find_faces
from torchface.landmarks.images.boxes.face_box import overlaps
from torchface.landmarks.images.find_faces import find_some_faces
from torchface.landmarks.images.ibug_68 import box_around
from torchface.rendering.clay_shading import render
from torchface.synthetic import performer


def portrait(yaw: float = 0.0, size: int = 160) -> tuple[Tensor, Tensor]:
    """The embedded performer in colour, uint8 (3,size,size), and the box round its landmarks."""
    head = performer().neutral
    middle = head.vertices[head.landmarks].mean(0)
    camera = look_at(middle, yaw, span=300.0, width=size, height=size)
    picture = render(head, camera, background=(0.3, 0.35, 0.4), samples=1)
    marks = camera.project(head.vertices[head.landmarks].double())
    return (picture.clamp(0, 1) * 255).round().to(torch.uint8), box_around(marks[None].float())[0]


@pytest.fixture(scope="module")
def face() -> tuple[Tensor, Tensor]:
    return portrait()


@pytest.fixture(scope="module")
def two_faces(face: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """A small face to the left, a large one to the right, and their boxes, the large one first."""
    picture, box = face
    small = torch.nn.functional.interpolate(picture[None].float(), size=(90, 90), mode="area")[0].to(torch.uint8)
    image = torch.full((3, 200, 320), 80, dtype=torch.uint8)
    image[:, 60:150, 10:100] = small
    image[:, 20:180, 140:300] = picture
    shrunk = (box + torch.tensor([0.5, 0.5, 0, 0])) * 90 / 160 - torch.tensor([0.5, 0.5, 0, 0])
    return image, torch.stack([box + torch.tensor([140, 20, 0, 0]), shrunk + torch.tensor([10, 60, 0, 0])])


def test_the_box_is_that_of_the_landmarks(face: tuple[Tensor, Tensor]) -> None:
    picture, box = face
    faces = find_faces(picture)
    assert len(faces) == 1
    assert float(overlaps(faces.boxes, box[None])) > 0.7
    assert 0 < float(faces.scores[0]) < 1
    grey = (picture.float() * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(0).round().to(torch.uint8)
    assert float(overlaps(find_faces(grey).boxes, faces.boxes)) > 0.9


def test_the_mirrored_face_has_the_mirrored_box(face: tuple[Tensor, Tensor]) -> None:
    picture, _ = face
    here, there = (find_faces(one).boxes[0] for one in (picture, picture.flip(-1)))
    across = torch.cat([picture.shape[-1] - 1 - there[:1] - there[2:3], there[1:]])
    assert float(overlaps(here[None], across[None])) > 0.9


def test_faces_come_largest_first_and_by_number(two_faces: tuple[Tensor, Tensor]) -> None:
    image, boxes = two_faces
    faces = find_faces(image)
    assert len(faces) == 2
    assert float(overlaps(faces.boxes, boxes).diagonal().min()) > 0.6
    assert torch.equal(find_some_faces(image, 1).boxes, faces.boxes)
    with pytest.raises(NoFaceError, match="found 2 faces, expected more than 2"):
        find_some_faces(image, 2)


def test_a_large_picture_gives_the_same_box(face: tuple[Tensor, Tensor]) -> None:
    picture, box = face
    large = torch.nn.functional.interpolate(picture[None].float(), size=(1280, 1280), mode="bilinear")[0]
    found = find_faces(large.to(torch.uint8)).boxes
    expected = (box + torch.tensor([0.5, 0.5, 0, 0])) * 8 - torch.tensor([0.5, 0.5, 0, 0])
    assert float(overlaps(found, expected[None])) > 0.7


def test_no_face_is_said() -> None:
    noise = torch.randint(0, 256, (3, 120, 160), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    assert len(find_faces(noise)) == 0
    assert len(find_faces(torch.zeros(8, 8, dtype=torch.uint8))) == 0
    with pytest.raises(NoFaceError, match="image of 160 x 120: found no face"):
        find_some_faces(noise)
    with pytest.raises(ShapeError, match="expected uint8"):
        find_faces(noise / 255)


def test_overlaps_are_shared_area_over_the_whole() -> None:
    boxes = torch.tensor([[0.0, 0, 2, 2], [1, 0, 2, 2], [5, 5, 1, 1]])
    expected = torch.tensor([[1, 1 / 3, 0], [1 / 3, 1, 0], [0, 0, 1]])
    assert torch.allclose(overlaps(boxes, boxes), expected)


@pytest.mark.real
def test_real_faces_are_found_and_nothing_else(data: Path) -> None:
    for frame in list(open_video(data / "video" / "single_face.mp4").frames())[::24]:
        assert len(find_faces(frame)) == 1
    for frame in list(open_video(data / "video" / "no_face.mp4").frames())[::24]:
        assert len(find_faces(frame)) == 0
    folder = data / "images" / "dlib_faces"
    # Boxes round the landmarks of dlib's predictor: a reference, no truth.
    reference: dict[str, list[Tensor]] = {}
    for labelled in load_dlib_faces(folder / "training_with_face_landmarks.xml"):
        reference.setdefault(labelled.image, []).append(box_around(labelled.points[None].float())[0])
    found = missed = 0
    for name, boxes in reference.items():
        picture = (load_image(folder / name) * 255).round().to(torch.uint8)
        faces: FaceBoxes = find_faces(picture)
        shared = overlaps(torch.stack(boxes), faces.boxes)
        found += int((shared.amax(1) > 0.4).sum())
        missed += int((shared.amax(1) <= 0.4).sum())
        assert (shared.amax(0) > 0.3).all(), f"{name}: a box where there is no face"
    assert found >= 15, f"{missed} faces missed"
