"""The profile of a line, learned: lines that are not dark, decoys that are, corners that are off."""

import math

import torch
from torch import Tensor

from torchface.landmarks.scans.contours import trace_contour
from torchface.landmarks.scans.line_shape import REACH, STATIONS, LineShape

COLUMNS = torch.arange(60.0, 161.0)


def lidded(seed: int, sag: float = 6.0, tone: float = 0.7) -> tuple[Tensor, Tensor]:
    """Skin with a fold (dark) 14 rows above the line, and the line itself where a bright band ends; (1,220,220) and
    the line (101,2)."""
    generator = torch.Generator().manual_seed(seed)
    rows = 110 - 0.06 * (COLUMNS - 60) + sag * torch.sin(math.pi * (COLUMNS - 60) / 100)
    y = torch.arange(220.0)[:, None]
    image = torch.full((220, 220), tone)
    image[:, 60:161] -= 0.35 * torch.exp(-0.5 * ((y - rows + 14) / 2.5) ** 2)
    image[:, 60:161] += 0.2 * torch.exp(-0.5 * ((y - rows + 3) / 2.0) ** 2)
    image += 0.03 * torch.randn(220, 220, generator=generator)
    return image[None], torch.stack([COLUMNS, rows], dim=-1)


def learned(corner_deviation: float = 0.0, with_profile: bool = True) -> LineShape:
    images, lines = zip(*(lidded(seed, 4.0 + seed, 0.6 + 0.03 * seed) for seed in range(5)), strict=True)
    return LineShape.fit(lines, images if with_profile else None, corner_deviation)


def test_a_line_that_is_not_the_darkest_is_found_by_its_look() -> None:
    image, line = lidded(9)
    left, right = line[0] + torch.tensor([0.0, 2.0]), line[-1] - torch.tensor([0.0, 2.0])
    found = trace_contour(image, left, right, shape=learned())
    assert (found.points[:, 1] - line[:, 1]).abs().mean() < 1.0
    dark = trace_contour(image, left, right, shape=learned(with_profile=False))
    assert (dark.points[:, 1] - line[:, 1]).abs().mean() > 2.0


def test_brightness_and_contrast_do_not_matter() -> None:
    image, line = lidded(9)
    first = trace_contour(image, line[0], line[-1], shape=learned())
    second = trace_contour(0.1 + 0.4 * image, line[0], line[-1], shape=learned())
    assert torch.equal(first.points, second.points)


def test_loose_corners_are_made_up_for() -> None:
    image, line = lidded(11)
    left, right = line[0] + torch.tensor([0.0, 9.0]), line[-1] + torch.tensor([0.0, 7.0])
    loose = trace_contour(image, left, right, shape=learned(corner_deviation=4.0))
    tight = trace_contour(image, left, right, shape=learned())
    assert (loose.points[:, 1] - line[:, 1]).abs().mean() < 1.0
    assert (loose.points[:, 1] - line[:, 1]).abs().mean() < (tight.points[:, 1] - line[:, 1]).abs().mean()


def test_the_look_has_mean_0_and_norm_1() -> None:
    shape = learned()
    assert shape.profile.shape == (STATIONS, 2 * REACH + 1)
    assert shape.profile.mean(1).abs().max() < 1e-6
    assert torch.allclose(shape.profile.norm(dim=1), torch.ones(STATIONS, dtype=shape.profile.dtype))
    # Bright above the line, darker at it than there.
    assert (shape.profile[:, REACH - 3] > shape.profile[:, REACH]).all()
