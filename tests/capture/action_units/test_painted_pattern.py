"""The painted pattern is what is bright in a region, or dark in all; a flow aligns it with another's."""

import pytest
import torch

from torchface.capture.action_units import RegionVideo
from torchface.capture.action_units.classifier_training import local_warps
from torchface.capture.action_units.painted_pattern import aligned_grid, neutral_flow, otsu_threshold, pattern_levels
from torchface.capture.action_units.painted_regions import region_grid, sample_regions
from torchface.errors import ShapeError, ValueRangeError


def test_the_threshold_separates_planted_classes() -> None:
    dark, bright = torch.linspace(0.1, 0.3, 300), torch.linspace(0.7, 1.6, 90)
    threshold = otsu_threshold(torch.cat([bright, dark]))
    assert float(dark.max()) < threshold < float(bright.min())
    assert otsu_threshold(torch.full((9,), 0.4)) == pytest.approx(0.4)


def test_paint_counts_by_how_much_of_a_pixel_it_covers() -> None:
    region = torch.full((1, 20, 20), 0.25)
    region[0, 5:9] = 0.85
    levels = pattern_levels(region, ["a"])
    probe = torch.tensor([[[0.25, 0.4, 0.55, 0.7, 0.85]]])
    assert levels.pattern(probe).flatten().tolist() == pytest.approx([0, 0, 0.2, 0.7, 1], abs=1e-5)
    # Twice the exposure changes nothing.
    brighter = pattern_levels(2 * region, ["a"])
    torch.testing.assert_close(brighter.pattern(2 * probe), levels.pattern(probe))


def test_dark_strokes_are_paint_too_and_lit_skin_beside_them_is_none() -> None:
    region = torch.full((1, 40, 40), 0.6)
    region[0, 5:9] = 0.05
    levels = pattern_levels(region, ["a"])
    assert levels.dark
    probe = torch.tensor([[[0.9, 0.6, 0.05]]])
    assert levels.pattern(probe).flatten().tolist() == [0, 0, 1]
    region[0, 27:] = 0.9  # where the light falls
    assert pattern_levels(region, ["a"]).dark
    brow = 1 - region  # white strokes, and as much of a dark brow
    levels = pattern_levels(brow, ["a"])
    assert not levels.dark
    assert levels.pattern(1 - probe).flatten().tolist() == [0, 0, 1]
    both = torch.stack([region[0], brow[0]])
    with pytest.raises(
        ValueRangeError, match="found no painted pattern, brighter than the skin or darker: 0% of region 'c'"
    ):
        pattern_levels(torch.cat([both, torch.full((1, 40, 40), 0.5)]), ["a", "b", "c"])


def test_a_flow_lays_one_pattern_on_another(regions: RegionVideo) -> None:
    reference = regions.neutral
    own = local_warps(reference[None], 1.5, torch.Generator().manual_seed(4))[0]
    before = (own - reference).abs().mean()
    size = reference.shape[-1]
    boxes = {str(i): (-0.5, -0.5, size - 0.5, size - 0.5) for i in range(len(reference))}
    grid = region_grid(boxes, list(boxes), size, size, size)
    moved = aligned_grid(grid, neutral_flow(own, reference))
    laid = torch.stack([
        sample_regions(own[i : i + 1], moved[i : i + 1], torch.eye(2, 3)[None])[0, 0] for i in range(len(own))
    ])  # fmt: skip
    assert (laid - reference).abs().mean() < 0.5 * before
    with pytest.raises(ShapeError, match="patterns"):
        neutral_flow(own[:2], reference)


def test_warps_are_small_smooth_and_the_same_again(regions: RegionVideo) -> None:
    images = regions.patterns[:4]
    warped = local_warps(images, 0.8, torch.Generator().manual_seed(0))
    assert torch.equal(warped, local_warps(images, 0.8, torch.Generator().manual_seed(0)))
    assert 0 < (warped - images).abs().mean() < 0.15
    torch.testing.assert_close(local_warps(images, 0.0, torch.Generator().manual_seed(0)), images, atol=1e-5, rtol=0)
