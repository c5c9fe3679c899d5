"""Colours of hair, brows and lips beside the skin's speak for one person or two, in any light."""

import pytest
import torch
from torch import Tensor

from tests.planted.planted_parts import planted_parts
from torchface.color_space import to_linear, to_srgb
from torchface.workflows.fit.color_evidence import color_evidence, part_colors

SKIN = (0.75, 0.55, 0.45)
COLORS = {"hair": (0.25, 0.18, 0.12), "brows": (0.3, 0.22, 0.16), "lips": (0.7, 0.35, 0.35)}


def picture(changed: dict[str, tuple[float, float, float]]) -> Tensor:
    """Stripes of skin and of the parts in their colours, (3,40,40)."""
    colors = [SKIN, *(COLORS | changed).values()]
    return torch.tensor(colors).T[:, :, None, None].expand(3, 4, 10, 40).reshape(3, 40, 40).contiguous()


def colors_of(image: Tensor, planted: Tensor) -> Tensor:
    at = {name: planted[:, 10 * row + 5, 0] for row, name in enumerate(COLORS, 1)}
    return part_colors(image, planted_parts(planted, at, 0.02))


def test_light_changes_none_of_the_colours_and_grey_pictures_have_no_lips() -> None:
    plain = picture({})
    lit = to_srgb(0.6 * torch.tensor([1.1, 1.0, 0.8])[:, None, None] * to_linear(plain))
    found, in_light = colors_of(plain, plain), colors_of(lit, plain)
    assert bool(found.isfinite().all())
    assert float((in_light - found).abs().max()) < 0.05
    grey = colors_of(plain.mean(0).expand(3, -1, -1), plain)
    assert bool(grey[2:].isnan().all())
    assert bool(grey[:2].isfinite().all())
    skin = torch.tensor(SKIN)[:, None, None].expand(3, 40, 40)
    assert bool(part_colors(skin, planted_parts(skin, {})).isnan().all())


@pytest.mark.parametrize(
    ("part", "color"), [("hair", (0.8, 0.7, 0.5)), ("brows", (0.72, 0.5, 0.4)), ("lips", (0.65, 0.5, 0.42))]
)
def test_each_part_of_another_colour_speaks_against_one_person(part: str, color: tuple[float, float, float]) -> None:
    plain, other = picture({}), picture({part: color})
    own, theirs = colors_of(plain, plain), colors_of(other, other)
    alike = color_evidence(torch.stack([own, own]))
    assert float(alike.min()) > 3
    assert float(color_evidence(torch.stack([own, theirs])).max()) < float(alike.min()) - 1.5
    unseen = torch.where(own == theirs, own, torch.nan)
    assert float(color_evidence(torch.stack([unseen, theirs])).min()) > 0
    odd = color_evidence(torch.stack([own, theirs, own]))
    assert int(odd.argmin()) == 1
    assert color_evidence(torch.full((2, 4), torch.nan).double()).tolist() == [0, 0]
