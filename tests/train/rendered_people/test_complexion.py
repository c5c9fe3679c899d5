"""Complexions: the mean is the painted head's, pigments darken, eyes stay."""

import pytest
import torch

from torchface.errors import ShapeError
from torchface.rendering.clay_shading import sample_texture
from torchface.synthetic import neutral_head
from train.rendered_people.complexion import COMPLEXION, complexion_colors, draw_complexions


def test_the_mean_is_the_painted_skin() -> None:
    mesh = neutral_head()
    corner = torch.zeros(len(mesh.vertices), dtype=torch.int64)
    corner[mesh.faces.flatten()] = mesh.uv_faces.flatten()
    expected = sample_texture(mesh.texture, mesh.uvs[corner].double())
    assert (complexion_colors(torch.zeros(1, 6))[0] - expected).abs().mean() < 2e-3


def test_each_parameter_changes_what_it_is_named_for() -> None:
    mesh = neutral_head(texture=False)
    regions = mesh.annotations.regions
    plain, changed = complexion_colors(torch.zeros(1, 6))[0], complexion_colors(2 * torch.eye(6))
    darker = (plain - changed).clamp(min=0).sum(-1)
    assert (changed <= plain + 1e-5).all()
    for name, region in (("melanin", "forehead"), ("redness", "chin"), ("lips", "lower_lip"), ("hair", "cranium")):
        row = darker[COMPLEXION.index(name)]
        assert row[regions[region]].mean() > 0.02, name
        assert row[regions["eyeball_left"]].abs().max() < 1e-5
    assert darker[COMPLEXION.index("lips"), regions["forehead"]].max() < 1e-5


def test_complexions_are_drawn_by_seed() -> None:
    first, second = (draw_complexions(5, torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first, second)
    with pytest.raises(ShapeError, match=r"expected \(N,6\)"):
        complexion_colors(torch.zeros(1, 5))
