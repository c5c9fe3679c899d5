"""Regions are read where they are; the painted pattern is what is bright in them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from planted.camera_stage import RecordedSession
from torchface.capture.action_units import RegionVideo, read_regions
from torchface.capture.action_units.classifier_training import local_warps
from torchface.capture.action_units.painted_pattern import aligned_grid, neutral_flow, otsu_threshold, pattern_levels
from torchface.capture.action_units.painted_regions import region_grid, sample_regions
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.io.video import write_video


def test_a_region_of_its_own_size_is_a_cut() -> None:
    frames = torch.rand(3, 40, 50, generator=torch.Generator().manual_seed(0))
    grid = region_grid({"a": (9.5, 4.5, 25.5, 20.5)}, ["a"], 16, 50, 40)
    still = torch.eye(2, 3).expand(3, 2, 3)
    torch.testing.assert_close(sample_regions(frames, grid, still)[:, 0], frames[:, 5:21, 10:26])
    moved = still.clone()
    moved[:, :, 2] = torch.tensor([3.0, -2.0])
    torch.testing.assert_close(sample_regions(frames, grid, moved)[:, 0], frames[:, 3:19, 13:29])


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


def test_a_flow_lays_one_pattern_on_another(regions: RegionVideo) -> None:
    reference = regions.neutral
    own = local_warps(reference[None], 1.5, torch.Generator().manual_seed(4))[0]
    before = (own - reference).abs().mean()
    size = reference.shape[-1]
    boxes = {str(i): (-0.5, -0.5, size - 0.5, size - 0.5) for i in range(len(reference))}
    grid = region_grid(boxes, list(boxes), size, size, size)
    for method, left in (("dis", 0.5), ("farneback", 0.7)):
        moved = aligned_grid(grid, neutral_flow(own, reference, method))
        laid = torch.stack([
            sample_regions(own[i : i + 1], moved[i : i + 1], torch.eye(2, 3)[None])[0, 0] for i in range(len(own))
        ])  # fmt: skip
        assert (laid - reference).abs().mean() < left * before, method
    with pytest.raises(ShapeError, match="patterns"):
        neutral_flow(own[:2], reference)


def test_warps_are_small_smooth_and_the_same_again(regions: RegionVideo) -> None:
    images = regions.patterns[:4]
    warped = local_warps(images, 0.8, torch.Generator().manual_seed(0))
    assert torch.equal(warped, local_warps(images, 0.8, torch.Generator().manual_seed(0)))
    assert 0 < (warped - images).abs().mean() < 0.15
    torch.testing.assert_close(local_warps(images, 0.0, torch.Generator().manual_seed(0)), images, atol=1e-5, rtol=0)


def test_bad_input_is_named(session: RecordedSession, regions: RegionVideo, tmp_path) -> None:  # type: ignore[no-untyped-def]
    video, labels = session.video, session.labels
    outside = replace(labels, regions=dict(labels.regions, mouth=(60.0, 100.0, 130.0, 150.0)))
    with pytest.raises(ValueRangeError, match=r"region 'mouth' is .* inside the image of 128 x 170"):
        read_regions(video, outside, ["mouth"])
    with pytest.raises(NameMismatchError, match="found no chin"):
        read_regions(video, labels, ["chin"])
    cheek = replace(labels, regions={"cheek": (30.0, 85.0, 42.0, 97.0)})
    with pytest.raises(ValueRangeError, match="'cheek' shows no painted pattern"):
        read_regions(video, cheek, ["cheek"])
    with pytest.raises(ShapeError, match=rf"found {labels.frames} frames, expected {labels.frames + 5} as its labels"):
        read_regions(video, replace(labels, frames=labels.frames + 5), ["mouth"])
    path = tmp_path / "broken.avi"
    path.write_bytes(video.path.read_bytes()[:200_000])
    with pytest.raises(FileFormatError, match="could be decoded"):
        read_regions(path, labels, ["mouth"])
    black = write_video([torch.zeros(labels.frames, 170, 128, dtype=torch.uint8)], tmp_path / "black.avi", 20.0)
    with pytest.raises(ValueRangeError, match="no painted pattern"):
        read_regions(black, labels, ["mouth"])
