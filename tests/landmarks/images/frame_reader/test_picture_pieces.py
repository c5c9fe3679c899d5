"""Squares of a picture as the library cuts them, and places of faces."""

import pytest
import torch
from torch import Tensor

from torchface.landmarks.images.face_crop import crop_transform, cut_crop, from_crop
from torchface.landmarks.images.frame_reader.face_place import place_around, relation, sought
from torchface.landmarks.images.frame_reader.picture_pieces import cut_square, from_square, whole_picture
from torchface.landmarks.images.ibug_68 import turned_box


def place_of(box: Tensor, tilt: float) -> Tensor:
    angle = torch.tensor(tilt)
    return torch.stack([*(box[:2] + box[2:] / 2), box[2], angle.cos(), angle.sin()])


@pytest.mark.parametrize(
    ("box", "tilt"), [((60, 40, 70, 70), 0.4), ((90, 60, 300, 300), -0.3), ((-40, 150, 90, 90), 1.0)]
)
def test_squares_are_cut_as_the_library_cuts_them(box: tuple[float, ...], tilt: float) -> None:
    """Inside, larger than their copy, and beyond the border; a fourth channel counts for nothing."""
    coarse = torch.rand(1, 3, 30, 40, generator=torch.Generator().manual_seed(1))
    picture = (255 * torch.nn.functional.interpolate(coarse, (240, 320), mode="bilinear")[0]).byte()
    opaque = torch.cat([picture, torch.full((1, 240, 320), 7, dtype=torch.uint8)])
    place, way = place_of(torch.tensor(box).float(), tilt), crop_transform(torch.tensor(box).float(), tilt, 64)
    expected = cut_crop(picture, way, 64).float() / 255
    for frame in (picture, opaque):
        found = cut_square(frame.permute(1, 2, 0), place, 64, 1.25)[0]
        assert float((found - expected).abs().max()) < 0.02
    points = torch.rand(9, 2) * 64
    torch.testing.assert_close(from_square(points, place, 64, 1.25), from_crop(points, way), atol=1e-3, rtol=0)


def test_places_are_the_boxes_of_landmarks() -> None:
    """And a face is looked for again where it was found, however it has turned, moved and grown meanwhile."""
    marks = 90 * torch.rand(68, 2, generator=torch.Generator().manual_seed(2)) + torch.tensor([300.0, 200.0])
    place = place_around(marks)
    box, tilt = turned_box(marks)
    torch.testing.assert_close(place, place_of(box, float(tilt)), atol=1e-3, rtol=0)
    looked = torch.cat([place[:3] * torch.tensor([1.0, 1.0, 1.1]) + torch.tensor([5.0, -10.0, 0.0]), place[3:]])
    anchor = relation(place, looked)
    torch.testing.assert_close(sought(place, anchor), looked, atol=1e-3, rtol=0)
    twice = torch.cat([2 * place[:3], place[3:]])
    torch.testing.assert_close(sought(twice, anchor)[:3], 2 * looked[:3], atol=1e-3, rtol=0)


def test_the_whole_is_made_smaller_and_padded() -> None:
    ramp = torch.arange(240).mul(255 / 239).byte()[:, None, None].expand(240, 300, 3)
    picture, ratio = whole_picture(ramp, 100)
    assert picture.shape == (1, 3, 96, 128)
    torch.testing.assert_close(ratio, torch.tensor([3.0, 3.0]))
    torch.testing.assert_close(picture[0, 0, :80, 0], torch.linspace(1, 238, 80) / 239, atol=0.01, rtol=0)
    assert torch.equal(picture[0, :, 79:80].expand(3, 17, 128), picture[0, :, 79:])
    assert whole_picture(ramp[:70, :5], 640)[0].shape == (1, 3, 96, 64)
