"""The network of face boxes says what it was taught, at every angle and size; its detector gives the image's pixels."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import zoo
from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.landmarks import BoxNetwork, BoxTrainingSettings, LabelledPicture, NetworkDetector
from torchface.landmarks.images.boxes.box_network import FaceMaps, face_geometry
from torchface.landmarks.images.boxes.box_training import box_loss
from torchface.landmarks.images.checked_detector import shipped_detector

FEW = BoxTrainingSettings(steps=180, batch=8, rate=2e-2, average=0.9, channels=(8, 12, 16, 16), blocks=(1, 1, 1, 1))


class Planted(BoxNetwork):
    """Says of images 96 pixels wide, or 150 and more, that they show these faces (F,4), whatever they show; of those of
    50 that they show others, and of all others that they show none."""

    def __init__(self, faces: Tensor, quarter: Tensor | None = None) -> None:
        super().__init__(FEW.channels, FEW.blocks)
        self.faces_said, self.quarter = faces, torch.zeros(0, 4) if quarter is None else quarter

    def maps(self, images: Tensor) -> FaceMaps:
        height, width = images.shape[2] // 8, images.shape[3] // 8
        centre, geometry = torch.full((1, 1, height, width), -9.0), torch.zeros(1, 5, height, width)
        whole, smaller = images.shape[3] >= 150 or images.shape[3] == 96, images.shape[3] == 50
        for face in self.faces_said if whole else self.quarter[: len(self.quarter) * smaller]:
            cell = ((face[:2] + 0.5) / 8 - 0.5).round()
            column, row = cell.long().tolist()
            centre[0, 0, row, column] = 4.0 if smaller else 3.0
            geometry[0, :, row, column] = 3.0 * face_geometry(face, cell)  # the angle's length does not count
            geometry[0, :3, row, column] /= 3.0
        return FaceMaps(centre, geometry)


FACES = torch.tensor([[100.3, 60.9, 40.0, 2.5], [30.0, 200.0, 90.0, -0.4]])


def mark(number: int) -> LabelledPicture:
    """A disc, its upper half light and its lower half dark, somewhere at some angle on grey."""
    generator = torch.Generator().manual_seed(number)
    drawn = torch.rand(4, generator=generator)
    side = 20 + 20 * drawn[2]
    face = torch.stack([side / 2 + (95 - side) * drawn[0], side / 2 + (95 - side) * drawn[1], side, 6.28 * drawn[3]])
    rows, columns = torch.meshgrid(torch.arange(96.0), torch.arange(96.0), indexing="ij")
    x, y = columns - face[0], rows - face[1]
    below = y * face[3].cos() - x * face[3].sin()
    grey = torch.where(x.square() + y.square() < (side / 2) ** 2, torch.where(below < 0, 230.0, 30.0), 128.0)
    noise = 10 * torch.randn(3, 96, 96, generator=generator)
    return LabelledPicture((grey + noise).clamp(0, 255).to(torch.uint8), face[None], torch.zeros(1, dtype=torch.bool))


@pytest.fixture(scope="module")
def taught() -> NetworkDetector:
    return NetworkDetector(BoxNetwork.fit(mark, FEW), 0.3)


def test_what_the_maps_say_is_what_is_found() -> None:
    found = Planted(FACES)(torch.zeros(1, 3, 256, 200))[0]
    likely = found[found[:, 3] > 0.5]
    assert likely.shape == (2, 6)
    order = likely[:, 0].argsort(descending=True)
    torch.testing.assert_close(likely[order, :3], FACES[:, :3], atol=1e-3, rtol=0)
    torch.testing.assert_close(torch.atan2(likely[order, 5], likely[order, 4]), FACES[:, 3], atol=1e-4, rtol=0)


def test_large_faces_are_those_of_smaller_copies_and_each_face_counts_once() -> None:
    """Of a face that two copies show the likelier counts; what lies inside of a likelier one is none."""
    large, same = torch.tensor([[120.0, 130.0, 150.0, 0.7]]), torch.tensor([[98.0, 63.0, 44.0, 2.4]])
    smaller = torch.cat([large, same])
    smaller[:, :2] = (smaller[:, :2] + 0.5) / 4 - 0.5
    smaller[:, 2] /= 4
    network = Planted(torch.cat([FACES[:1], torch.tensor([[128.0, 120.0, 20.0, 0.0]])]), smaller)
    with torch.no_grad():
        found = network(torch.zeros(1, 3, 256, 200))[0]
    likely = found[found[:, 3] > 0.5]
    assert likely.shape == (2, 6)
    by_side = likely[likely[:, 2].argsort()]
    torch.testing.assert_close(by_side[1, :3], large[0, :3], atol=1e-3, rtol=0)
    assert float((by_side[0, :2] - FACES[0, :2]).norm()) < 4
    assert (found[:-1, 3] >= found[1:, 3]).all()


def test_the_detector_gives_boxes_in_the_pixels_of_the_image() -> None:
    faces = NetworkDetector(Planted(FACES), longest=256)(torch.zeros(3, 512, 300, dtype=torch.uint8))  # half the size
    x, y, side, tilt = FACES[[1, 0]].unbind(1)
    middle = (torch.stack([x, y], 1) + 0.5) * 2 - 0.5
    torch.testing.assert_close(faces.boxes[:, :2] + faces.boxes[:, 2:] / 2, middle, atol=1e-3, rtol=0)
    torch.testing.assert_close(faces.boxes[:, 2], 2 * side, atol=1e-3, rtol=0)
    torch.testing.assert_close(faces.tilts, tilt, atol=1e-4, rtol=0)


def test_marks_it_was_taught_are_found_where_they_are(taught: NetworkDetector) -> None:
    for number in range(5000, 5012):
        picture = mark(number)
        found = taught(picture.image)
        assert len(found) == 1
        middle = found.boxes[0, :2] + found.boxes[0, 2:] / 2
        assert float((middle - picture.faces[0, :2]).norm()) < 0.25 * float(picture.faces[0, 2])
        assert float(found.boxes[0, 2] / picture.faces[0, 2]) == pytest.approx(1.0, abs=0.2)
        off = math.remainder(float(found.tilts[0] - picture.faces[0, 3]), 2 * math.pi)
        assert abs(off) < 0.35


def test_a_turned_picture_turns_the_box(taught: NetworkDetector) -> None:
    image = mark(6001).image
    upright, turned = taught(image), taught(image.rot90(-1, (1, 2)))  # clockwise
    x, y = (upright.boxes[0, :2] + upright.boxes[0, 2:] / 2).tolist()
    middle = turned.boxes[0, :2] + turned.boxes[0, 2:] / 2
    assert float((middle - torch.tensor([95 - y, x])).abs().max()) < 3
    off = math.remainder(float(turned.tilts[0] - upright.tilts[0]) - math.pi / 2, 2 * math.pi)
    assert abs(off) < 0.3  # what is learned depends on how a processor rounds


def test_the_shipped_network_is_small_and_finds_nobody_on_a_wall() -> None:
    assert zoo.describe("face_boxes").size < 500_000
    assert len(shipped_detector()(torch.full((3, 240, 320), 128, dtype=torch.uint8))) == 0


def test_a_plain_picture_shows_nobody(taught: NetworkDetector) -> None:
    assert len(taught(torch.full((3, 96, 128), 128, dtype=torch.uint8))) == 0
    assert len(taught(torch.full((20, 9), 128, dtype=torch.uint8))) == 0  # smaller than the network takes


def test_folded_normalisation_changes_nothing() -> None:
    network = BoxNetwork.fit(mark, BoxTrainingSettings(2, 8, channels=FEW.channels, blocks=FEW.blocks))
    image = mark(1).image[:, :1, :1].expand(3, 128, 128).clone()  # of a size that is shown as it is
    image[:, :96, :96] = mark(1).image
    found = NetworkDetector(network, 1e-6)(image)
    expected = network(image[None].float() / 255)[0]
    likeliest = found.scores.argmax()
    torch.testing.assert_close(found.scores[likeliest], expected[0, 3], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(found.boxes[likeliest, 2], expected[0, 2], atol=1e-3, rtol=1e-4)


def test_the_loss_is_least_at_the_truth_and_leaves_uncertain_faces_out() -> None:
    faces = torch.tensor([[[52.0, 44.0, 30.0, 0.3], [20.0, 80.0, 16.0, 0.0]]])
    uncertain = torch.tensor([[False, True]])
    planted = Planted(faces[0, :1]).maps(torch.zeros(1, 3, 96, 96))
    geometry = torch.zeros(1, 5, 12, 12)
    for row in range(12):
        for column in range(12):
            geometry[0, :, row, column] = face_geometry(faces[0, 0], torch.tensor([float(column), float(row)]))
    best = float(box_loss(FaceMaps(planted.centre * 3, geometry), faces, uncertain))
    assert best < 0.05
    larger = geometry.clone()
    larger[:, 2] += 0.3
    assert float(box_loss(FaceMaps(planted.centre * 3, larger), faces, uncertain)) > best + 0.3
    there = planted.centre * 3
    there[0, 0, 10, 2] = 9.0  # the uncertain one is said to be there
    assert float(box_loss(FaceMaps(there, geometry), faces, uncertain)) == pytest.approx(best, abs=1e-6)
    there[0, 0, 1, 10] = 9.0  # where nobody is
    assert float(box_loss(FaceMaps(there, geometry), faces, uncertain)) > best + 1


def test_a_killed_run_ends_where_it_would_have_ended(tmp_path: Path) -> None:
    settings = BoxTrainingSettings(6, 8, channels=FEW.channels, blocks=FEW.blocks, checkpoint_every=0)
    whole = BoxNetwork.fit(mark, settings)
    checkpoint = tmp_path / "checkpoint.safetensors"

    def killed(message: str, done: int = 0, total: int = 0) -> None:
        if done == 5:  # after the checkpoint of step 4
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        BoxNetwork.fit(mark, settings, killed, checkpoint)
    again = BoxNetwork.fit(mark, settings, None, checkpoint)
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value, rtol=0, atol=0, msg=name)
    with pytest.raises(FileFormatError, match="other data or settings"):
        BoxNetwork.fit(mark, replace(settings, seed=3), None, checkpoint)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueRangeError, match="found channels"):
        BoxNetwork((8, 8, 8), (1, 1, 1, 1))
    with pytest.raises(ShapeError, match="64 pixels a side"):
        BoxNetwork(FEW.channels, FEW.blocks)(torch.zeros(1, 3, 32, 96))
    with pytest.raises(ValueRangeError, match="found score 0"):
        NetworkDetector(Planted(FACES), 0)
