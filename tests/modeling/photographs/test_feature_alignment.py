"""Claim: a photograph is bent so that its eyes, nose and lips lie where the fitted head has them; brows stay."""

import pytest
import torch
from torch import Tensor

from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.landmarks.images.networks.part_network import PARTS
from torchface.modeling.photographs.feature_alignment import FeatureAlignment
from torchface.modeling.photographs.landmark_view import JAW
from torchface.synthetic import performer

SIDE = 240
EYES, LIPS = slice(36, 48), slice(48, 68)


@pytest.fixture(scope="module")
def fitted() -> Tensor:
    rig = performer(texture=False)
    face = rig.vertices[rig.neutral.landmarks][:, :2].double() * torch.tensor([1.0, -1.0])
    return 110 + 70 * (face - face.mean(0)) / (face[45] - face[36]).norm()


@pytest.fixture(scope="module")
def residuals(fitted: Tensor) -> Tensor:
    """Eyes too high by 3 pixels and lips too far to the left by 5, so that the way between them is smooth."""
    share = ((fitted[:, 1] - fitted[EYES, 1].mean()) / (fitted[LIPS, 1].mean() - fitted[EYES, 1].mean())).clamp(0, 1)
    return torch.stack([-5 * share, -3 * (1 - share)], dim=-1)


def spots(places: Tensor) -> Tensor:
    """A picture (3,SIDE,SIDE) of a white spot at each place."""
    side = torch.arange(SIDE, dtype=torch.float64)
    away = (side[None, None] - places[:, 0, None, None]) ** 2 + (side[None, :, None] - places[:, 1, None, None]) ** 2
    return torch.exp(-away / 8).amax(0).float().expand(3, -1, -1).contiguous()


def test_features_come_to_where_the_head_has_them(fitted: Tensor, residuals: Tensor) -> None:
    way = FeatureAlignment.of(fitted, residuals)
    for part in (EYES, LIPS, slice(27, 36)):
        found = fitted[part] - residuals[part]
        assert (
            float((way.points(found) - fitted[part]).norm(dim=1).mean())
            < 0.6
            < float(residuals[part].norm(dim=1).min())
        )
    one = torch.stack([fitted[39], fitted[42], fitted[48]])
    bent = way.image(spots(one - residuals[[39, 42, 48]]))[0]
    for place in one:
        x, y = place.round().long().tolist()
        window = bent[y - 6 : y + 7, x - 6 : x + 7].double()
        offsets = torch.arange(-6, 7).double()
        middle = torch.stack([(window.sum(0) * offsets).sum(), (window.sum(1) * offsets).sum()]) / window.sum()
        assert float((torch.tensor([x, y]) + middle - place).norm()) < 1.0


def test_brows_stay_and_contours_do_not_slide(fitted: Tensor) -> None:
    off = torch.zeros(68, 2)
    off[17:27] = 6.0
    along = torch.nn.functional.normalize(fitted[2:JAW] - fitted[: JAW - 2], dim=-1)
    off[1 : JAW - 1] = 4 * along.float()
    way = FeatureAlignment.of(fitted, off)
    assert float(way.to_found.at(fitted).norm(dim=1).max()) < 0.6


def test_an_exact_fit_leaves_the_picture_as_it_is(fitted: Tensor) -> None:
    off = torch.zeros(68, 2)
    off[40] = torch.nan
    way, picture = FeatureAlignment.of(fitted, off), spots(fitted)
    torch.testing.assert_close(way.image(picture), picture, atol=1e-6, rtol=0)


def test_parts_are_bent_as_their_picture(fitted: Tensor, residuals: Tensor) -> None:
    way = FeatureAlignment.of(fitted, residuals)
    size = SIDE // 2
    transform = torch.tensor([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25]], dtype=torch.float64)

    def parts(places: Tensor) -> FaceParts:
        shares = torch.nn.functional.interpolate(spots(places)[None, :1], size=(size, size), mode="area")[0]
        return FaceParts(shares.expand(len(PARTS), -1, -1).contiguous(), transform)

    found, exact = parts(fitted - residuals), parts(fitted).at(fitted[LIPS], "skin").mean()
    assert float(way.parts(found).at(fitted[LIPS], "skin").mean()) > 0.85 * float(exact)
    assert float(found.at(fitted[LIPS], "skin").mean()) < 0.6 * float(exact)
