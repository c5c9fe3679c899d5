"""The stage does to markers what it says it does, and remembers the truth."""

import pytest
import torch

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.similarity import similarity_transform
from torchface.rig import BlendshapeRig
from torchface.synthetic.stages.marker_stage import StageFlaws, place_markers, record


def moving(frames: int, shapes: int = 4) -> torch.Tensor:
    phase = torch.arange(shapes) * 1.3
    return 0.5 + 0.5 * torch.sin(torch.arange(frames)[:, None] / 20 + phase)


def test_markers_are_placed_apart_on_visible_skin_that_moves(dome_rig: BlendshapeRig) -> None:
    rig = dome_rig
    attachment = place_markers(rig, 40)
    points = attachment.on(rig.neutral.faces, rig.vertices)
    distances = torch.cdist(points, points) + 1e9 * torch.eye(40)
    assert distances.min() > 4.0
    motion = attachment.on(rig.neutral.faces, rig.deltas).norm(dim=-1).amax(0)
    assert motion.min() > 0.5
    assert (points[:, 1] > -36).all()
    with pytest.raises(ValueRangeError, match="expected 5000"):
        place_markers(rig, 5000)


def test_without_flaws_the_take_is_the_attachment_on_the_moving_rig(dome_rig: BlendshapeRig) -> None:
    rig = dome_rig
    attachment = place_markers(rig, 20)
    weights = moving(50)
    recording = record(rig, attachment, weights, torch.Generator().manual_seed(0), StageFlaws(noise=0))
    expected = attachment.on(rig.neutral.faces, rig(weights))
    torch.testing.assert_close(recording.take.markers.values, expected, atol=1e-4, rtol=0)


def test_noise_gaps_and_missing_samples_have_the_size_asked_for(dome_rig: BlendshapeRig) -> None:
    rig = dome_rig
    attachment = place_markers(rig, 40)
    flaws = StageFlaws(noise=0.3, missing=0.1, gaps=6, gap_seconds=0.5)
    recording = record(rig, attachment, moving(3600), torch.Generator().manual_seed(0), flaws)
    values = recording.take.markers.values
    error = (values - recording.markers)[torch.isfinite(values).all(-1)]
    assert abs(float(error.std()) - 0.3) < 0.005
    share = float(torch.isnan(values[..., 0]).float().mean())
    assert 0.1 < share < 0.1 + 6 * 0.5 / 60  # stretches are up to half a second, six a minute


def test_slip_is_the_rigid_motion_that_comes_back_with_it(dome_rig: BlendshapeRig) -> None:
    rig = dome_rig
    attachment = place_markers(rig, 30)
    flaws = StageFlaws(noise=0, slip_translation=10, slip_rotation=4)
    recording = record(rig, attachment, moving(600), torch.Generator().manual_seed(3), flaws)
    found = similarity_transform(recording.markers, recording.take.markers.values, scale=False)
    torch.testing.assert_close(found.rotation, recording.rotation, atol=1e-4, rtol=0)
    assert abs(float(recording.translation.abs().amax(0).min()) - 10) < 1e-3
    angle = torch.rad2deg(torch.arccos((recording.rotation.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2))
    assert 4 <= float(angle.max()) < 4 * 3**0.5 + 0.1


def test_swapped_labels_are_the_ones_reported(dome_rig: BlendshapeRig) -> None:
    rig = dome_rig
    attachment = place_markers(rig, 30)
    recording = record(rig, attachment, moving(1800), torch.Generator().manual_seed(4), StageFlaws(noise=0, swaps=12))
    assert len(recording.swaps) == 6
    repaired = recording.take.markers.values.clone()
    for swap in reversed(recording.swaps):
        stretch = slice(swap.first, swap.last)
        repaired[stretch, list(swap.markers)] = repaired[stretch, list(swap.markers[::-1])]
    torch.testing.assert_close(repaired, recording.markers)


def test_standoff_lifts_markers_along_the_normal(dome_rig: BlendshapeRig) -> None:
    rig = dome_rig
    attachment = place_markers(rig, 30)
    weights = moving(20)
    on_skin = record(rig, attachment, weights, torch.Generator(), StageFlaws(noise=0)).markers
    lifted = record(rig, attachment, weights, torch.Generator(), StageFlaws(noise=0, standoff=2)).markers
    torch.testing.assert_close((lifted - on_skin).norm(dim=-1), torch.full((20, 30), 2.0))
    assert (lifted - on_skin)[..., 2].min() > 0


def test_same_seed_same_take_and_bad_settings_are_named(dome_rig: BlendshapeRig) -> None:
    rig = dome_rig
    attachment = place_markers(rig, 10)
    takes = [record(rig, attachment, moving(9), torch.Generator().manual_seed(7)).take for _ in range(2)]
    assert torch.equal(takes[0].markers.values, takes[1].markers.values)
    with pytest.raises(ValueRangeError, match="noise is -1, expected"):
        StageFlaws(noise=-1)
    with pytest.raises(ShapeError, match=r"expected \(T,4\)"):
        record(rig, attachment, torch.zeros(3, 5), torch.Generator())
