"""Faces are found where they are, and only there; what is no network is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.geometry.cameras.pinhole import look_at
from torchface.io.images.image_files import load_image
from torchface.io.landmarks.dlib_xml import load_dlib_faces
from torchface.io.video import open_video
from torchface.landmarks.images.boxes.face_box import (
    FaceBoxes,
    HaarDetector,
    NoFaceError,
    YuNetDetector,
    find_face,
    find_faces,
    overlaps,
)
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
    here, there = find_face(picture), find_face(picture.flip(-1))
    across = torch.cat([picture.shape[-1] - 1 - there[:1] - there[2:3], there[1:]])
    assert float(overlaps(here[None], across[None])) > 0.9


def test_faces_come_largest_first_and_by_number(two_faces: tuple[Tensor, Tensor]) -> None:
    image, boxes = two_faces
    faces = find_faces(image)
    assert len(faces) == 2
    assert float(overlaps(faces.boxes, boxes).diagonal().min()) > 0.6
    assert torch.equal(find_face(image, 1), faces.boxes[1])
    with pytest.raises(NoFaceError, match="found 2 faces, expected more than 2"):
        find_face(image, 2)


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
        find_face(noise)
    with pytest.raises(ShapeError, match="expected uint8"):
        find_faces(noise / 255)
    with pytest.raises(ValueRangeError, match="smallest"):
        HaarDetector(smallest=0)


def test_overlaps_are_shared_area_over_the_whole() -> None:
    boxes = torch.tensor([[0.0, 0, 2, 2], [1, 0, 2, 2], [5, 5, 1, 1]])
    expected = torch.tensor([[1, 1 / 3, 0], [1 / 3, 1, 0], [0, 0, 1]])
    assert torch.allclose(overlaps(boxes, boxes), expected)


def yunet_like(path: Path, planted: tuple[float, ...]) -> Path:
    """A network with YuNet's outputs that scores a cell of 8 x 8 pixels by its brightness.

    ``planted`` are the ten numbers that say where the five points lie from the cell's corner, in cells.
    """
    nodes, outputs, constants = [], [], []

    def constant(name: str, values: np.ndarray) -> str:
        constants.append(onnx.numpy_helper.from_array(values, name))
        return name

    for stride in (8, 16, 32):
        light = f"light{stride}"
        first = np.zeros((1, 3, stride, stride), np.float32)
        first[:] = 1 / (3 * 255 * stride * stride) if stride == 8 else 0
        weights = constant(f"w{stride}", first)
        nodes.append(onnx.helper.make_node("Conv", ["input", weights], [light], strides=[stride, stride]))
        for name, rows in (("cls", 1), ("obj", 1), ("bbox", 4), ("kps", 10)):
            slope = np.zeros((rows, 1, 1, 1), np.float32)
            slope[:] = 1 if name in ("cls", "obj") else 0
            offset = np.zeros(rows, np.float32)
            if name == "kps":
                offset[:] = planted
            made = [
                constant(f"{name}s{stride}", slope),
                constant(f"{name}o{stride}", offset),
                constant(f"{name}r{stride}", np.array([1, -1, rows], np.int64)),
            ]
            mid = f"{name}{stride}"
            nodes.append(onnx.helper.make_node("Conv", [light, made[0], made[1]], [mid]))
            nodes.append(onnx.helper.make_node("Transpose", [mid], [mid + "t"], perm=[0, 2, 3, 1]))
            nodes.append(onnx.helper.make_node("Reshape", [mid + "t", made[2]], [f"{name}_{stride}"]))
            outputs.append(
                onnx.helper.make_tensor_value_info(f"{name}_{stride}", onnx.TensorProto.FLOAT, [1, None, rows])
            )
    image = onnx.helper.make_tensor_value_info("input", onnx.TensorProto.FLOAT, [1, 3, 160, 160])
    graph = onnx.helper.make_graph(nodes, "faces", [image], outputs, constants)
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 13)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path


def test_a_yunet_file_is_used_as_it_says(tmp_path: Path) -> None:
    middle, reach = torch.tensor([0.5, 0.5]), 4.0
    five = torch.tensor([[0.33, 0.374], [0.68, 0.374], [0.49, 0.572], [0.357, 0.758], [0.655, 0.758]])
    detector = YuNetDetector(yunet_like(tmp_path / "y.onnx", tuple(((five - middle) * reach).flatten().tolist())))
    image = torch.zeros(3, 160, 160, dtype=torch.uint8)
    assert len(find_faces(image, detector)) == 0
    image[:, 80:88, 40:48] = 255  # the cell whose corner is (40, 80); a box of 32 pixels round it is planted
    faces = find_faces(image, detector)
    assert len(faces) == 1
    assert torch.allclose(faces.boxes[0], torch.tensor([24.0, 64, 32, 32]), atol=0.1)
    assert float(faces.scores[0]) == pytest.approx(1.0, abs=0.01)


def test_what_is_no_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="cannot be read"):
        YuNetDetector(tmp_path / "missing.onnx")
    (tmp_path / "text.onnx").write_bytes(b"this is no network")
    with pytest.raises(FileFormatError, match="no valid ONNX"):
        YuNetDetector(tmp_path / "text.onnx")
    (tmp_path / "empty.onnx").write_bytes(b"")
    with pytest.raises(FileFormatError, match="0 bytes"):
        YuNetDetector(tmp_path / "empty.onnx")
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
    other = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Relu", ["x"], ["y"])], "g", [value], [other])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 13)], ir_version=8)
    (tmp_path / "other.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(FileFormatError, match=r"found outputs y, expected a YuNet network's \(cls_8"):
        YuNetDetector(tmp_path / "other.onnx")


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
