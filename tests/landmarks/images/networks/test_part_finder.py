"""Parts of a face: shares are found again at pixels of the picture, and both sides of a face count alike."""

import math

import pytest
import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.pinhole import look_at
from torchface.landmarks.images.networks.part_finder import FaceParts, PartFinder
from torchface.landmarks.images.networks.part_network import PART_SIZE, PARTS, PartNetwork
from torchface.synthetic import neutral_head


def red_is_skin(crops: Tensor) -> Tensor:
    """Skin where a picture is red, else background, as a network would say."""
    skin = (crops[:, 0] > 0.5).float()
    shares = torch.zeros(len(crops), len(PARTS), *crops.shape[2:])
    shares[:, 0], shares[:, 1] = 1 - skin, skin
    return shares


def test_parts_are_where_the_picture_shows_them() -> None:
    angle = torch.linspace(0, 2 * math.pi, 69)[:68]
    landmarks = torch.stack([150 + 40 * angle.cos(), 130 + 40 * angle.sin()], 1)
    y, x = torch.meshgrid(torch.arange(260), torch.arange(300), indexing="ij")
    red = (x - 150) > 0.4 * (y - 130)  # the right half, by a slanted line
    image = torch.stack([255 * red, 0 * red, 0 * red]).byte()
    found = PartFinder(red_is_skin)(image, landmarks)
    places = torch.cartesian_prod(torch.arange(110, 190, 7), torch.arange(90, 170, 7)).double()
    aside = (places[:, 0] - 150) - 0.4 * (places[:, 1] - 130)
    clear = aside.abs() > 4
    share = found.at(places, "skin")
    assert torch.equal(share[clear] > 0.5, aside[clear] > 0)
    torch.testing.assert_close(share + found.at(places, "background"), torch.ones(len(share)))
    assert bool(found.at(torch.tensor([[2.0, 2.0]]), "skin").isnan().all())
    missing = landmarks.clone()
    missing[5] = torch.nan
    again = PartFinder(red_is_skin)(image, missing)
    assert float((again.transform - found.transform).abs().max()) < 3


def test_cloth_without_a_hue_over_the_nose_is_grey_hair() -> None:
    """The network takes grey hair for cloth."""
    head = neutral_head(texture=False)
    camera = look_at(head.vertices[head.landmarks].mean(0), 0.0, span=400.0, width=100, height=100)
    landmarks = camera.project(head.vertices[head.landmarks].double()).float()

    def all_cloth(crops: Tensor) -> Tensor:
        shares = torch.zeros(len(crops), len(PARTS), *crops.shape[2:])
        shares[:, PARTS.index("cloth")] = 1.0
        return shares

    image = torch.full((3, 100, 100), 120, dtype=torch.uint8)
    image[:, :, 50:] = torch.tensor([140, 60, 60], dtype=torch.uint8)[:, None, None]  # a red cap
    found = PartFinder(all_cloth)(image, landmarks)
    nose = float(landmarks[30, 1])
    places = torch.tensor([[35.0, nose - 15], [65.0, nose - 15], [35.0, nose + 15]])
    torch.testing.assert_close(found.at(places, "hair"), torch.tensor([1.0, 0.0, 0.0]))
    torch.testing.assert_close(found.at(places, "cloth"), torch.tensor([0.0, 1.0, 1.0]))


def test_shares_of_a_crop_sum_to_one_at_its_own_size() -> None:
    network = PartNetwork((4, 4, 4, 4), (1, 0, 0, 1)).eval()
    with torch.no_grad():
        shares = network(torch.rand(2, 3, 32, 48, generator=torch.Generator().manual_seed(0)))
    assert shares.shape == (2, len(PARTS), 32, 48)
    torch.testing.assert_close(shares.sum(1), torch.ones(2, 32, 48))
    again = PartNetwork.from_config(network.config)
    assert [one.shape for one in again.state_dict().values()] == [one.shape for one in network.state_dict().values()]
    with pytest.raises(ShapeError, match="multiples of 16"):
        network(torch.zeros(1, 3, 40, 32))
    with pytest.raises(ValueRangeError, match="channels"):
        PartNetwork((4, 4, 4))


def test_a_share_between_pixels_is_their_mean() -> None:
    shares = torch.zeros(len(PARTS), PART_SIZE, PART_SIZE)
    shares[2, :, 10:] = 1.0
    parts = FaceParts(shares, torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).double())
    found = parts.at(torch.tensor([[9.0, 5.0], [9.25, 5.0], [10.0, 5.0]]), "hair")
    torch.testing.assert_close(found, torch.tensor([0.0, 0.25, 1.0]))
