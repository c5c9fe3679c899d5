"""Planted exposure and white balance are found and taken off; what differs between people stays."""

from dataclasses import replace

import pytest
import torch

from torchface.color_space import to_linear, to_srgb
from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.modeling import MorphableModel
from torchface.synthetic import neutral_head
from train.color_casts import color_casts, texture_areas, without_cast
from train.rendered_people.complexion import complexion_colors, draw_complexions


@pytest.fixture(scope="module")
def people() -> torch.Tensor:
    return complexion_colors(draw_complexions(12, torch.Generator().manual_seed(0)))


@pytest.fixture(scope="module")
def planted() -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    exposure = 0.3 * torch.randn(12, 1, generator=generator)
    balance = 0.12 * torch.randn(12, 3, generator=generator)
    return exposure + balance


@pytest.fixture(scope="module")
def photographed(people: torch.Tensor, planted: torch.Tensor) -> torch.Tensor:
    """Under each one's own light, in eight bits, blown out where it is too bright."""
    return (to_srgb(to_linear(people) * planted[:, None].exp()).clamp(0, 1) * 255).round() / 255


def test_the_planted_cast_is_found(people: torch.Tensor, planted: torch.Tensor, photographed: torch.Tensor) -> None:
    weights = texture_areas(neutral_head(texture=False))
    own = color_casts(people, weights)  # what the people themselves differ by as a whole
    found = color_casts(photographed, weights)
    assert (found - own - (planted - planted.mean(0))).abs().max() < 0.02
    assert found.mean(0).abs().max() < 1e-6


def test_colours_under_any_light_come_out_the_same(people: torch.Tensor, photographed: torch.Tensor) -> None:
    weights = texture_areas(neutral_head(texture=False))
    clean, again = (without_cast(x, color_casts(x, weights)) for x in (people, photographed))
    # The light that all share cannot be known: a gain for the whole set remains.
    share = (to_linear(again) / to_linear(clean).clamp(min=1e-3)).flatten(0, 1).median(0).values
    again = to_srgb(to_linear(again) / share)
    kept = (photographed < 0.98) & (clean < 0.98) & (photographed > 0.1)
    assert (again - clean)[kept].abs().quantile(0.99) < 0.01
    assert (photographed - people)[kept].abs().mean() > 0.05
    # So the models learned from both say the same, where the one of the photographs as they are is wide of it.
    spread = [MorphableModel.fit(x, 5) for x in (clean, again, photographed)]
    assert torch.allclose(spread[0].standard_deviations[:3], spread[1].standard_deviations[:3], rtol=0.05)
    assert spread[2].standard_deviations[0] > 1.5 * spread[0].standard_deviations[0]


def test_make_up_of_one_does_not_count_as_light(people: torch.Tensor) -> None:
    mesh = neutral_head(texture=False)
    painted = people.clone()
    painted[3, mesh.annotations.regions["forehead"]] *= torch.tensor([0.3, 0.3, 0.9])
    before, after = color_casts(people), color_casts(painted)
    plain = to_linear(painted[3]).log().mean(0) - to_linear(people[3]).log().mean(0)
    assert (after - before)[3].abs().max() < 0.25 * plain.abs().max()


def test_texture_areas_are_shares_of_the_texels() -> None:
    mesh = neutral_head(texture=False)
    areas = texture_areas(mesh)
    assert float(areas.sum()) == pytest.approx(1)
    assert (areas >= 0).all()
    assert torch.allclose(texture_areas(replace(mesh, uvs=0.5 * mesh.uvs)), areas, atol=1e-7)
    with pytest.raises(TopologyError, match="no texture coordinates"):
        texture_areas(replace(mesh, uvs=None, uv_faces=None))


def test_colours_that_tell_nothing_are_refused(people: torch.Tensor) -> None:
    dark = people.clone()
    dark[5] = 0
    with pytest.raises(ValueRangeError, match="number 5 is black"):
        color_casts(dark)
    with pytest.raises(ShapeError, match="weights"):
        color_casts(people, torch.ones(3))
    with pytest.raises(ShapeError, match=r"expected \(M,V,3\)"):
        color_casts(people[0])
    dark[5, 0, 0] = float("nan")
    with pytest.raises(ValueRangeError, match="NaN"):
        color_casts(dark)
