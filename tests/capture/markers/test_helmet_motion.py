"""The rigid motion of a head is seen in its markers alone, and expressions are none."""

from dataclasses import replace

import pytest
import torch

from torchface import Take, Track
from torchface.capture.markers.helmet_motion import HelmetMotion, free_motion, steady_take
from torchface.geometry.rotations import rotation_matrix, rotation_vector
from torchface.geometry.similarity import Similarity
from torchface.synthetic import performer
from torchface.synthetic.stages.marker_stage import StageFlaws, place_markers, record
from torchface.synthetic.stages.weight_curves import perform


@pytest.fixture(scope="module")
def still() -> Take:
    """A performance of two seconds with gaps, exchanged labels and noise, without any motion of the head."""
    rig = performer(texture=False)
    weights = rig.weights_from(perform(120, torch.Generator().manual_seed(4)).weights)
    flaws = StageFlaws(missing=0.05, swaps=60)
    return record(rig, place_markers(rig, 40), weights, torch.Generator().manual_seed(0), flaws).take


def motion_of(count: int, turn: float, way: float) -> HelmetMotion:
    phase = torch.linspace(0, 6, count).double()
    rotation = rotation_matrix(turn * torch.stack([0.3 * phase.sin(), phase.cos(), 0 * phase], 1))
    return HelmetMotion(rotation, way * torch.stack([phase.sin(), 0 * phase, phase.cos()], 1), torch.zeros(3).double())


@pytest.mark.parametrize(
    ("turn", "way", "freely"), [(0.14, 0.0, False), (0.7, 0.0, True), (0.0, 50.0, True), (1.5, 900.0, True)]
)
def test_the_motion_is_found_but_for_a_few_degrees(still: Take, turn: float, way: float, freely: bool) -> None:
    true = motion_of(len(still), turn, way)
    moved = replace(still, markers=Track(still.markers.names, true.apply(still.markers.values.double())))
    assert (free_motion(moved.markers.values) is not None) == freely
    steady, found = steady_take(moved)
    # Both are relative to some pose of the head.
    left = found.rotation.transpose(1, 2) @ true.rotation
    angles = torch.rad2deg(rotation_vector(left @ left[60].T)).norm(dim=1)
    assert angles.median() < 2
    values = steady.markers.values
    assert (values - values.nanmedian(0).values).norm(dim=-1).nanmedian() < 3


def test_expressions_are_no_motion_of_the_head(still: Take) -> None:
    take, motion = steady_take(still)
    assert take is still
    assert motion is None


def test_motions_follow_one_another_and_go_to_another_space() -> None:
    points = torch.randn(5, 7, 3, generator=torch.Generator().manual_seed(0)).double()
    first, second = (
        motion_of(5, 0.4, 20.0),
        replace(motion_of(5, -0.3, 7.0), pivot=torch.tensor([1.0, 2.0, 3.0]).double()),
    )
    torch.testing.assert_close(second.after(first).apply(points), second.apply(first.apply(points)))
    turn = rotation_matrix(torch.tensor([[0.1, 0.5, -0.2]])).double()
    space = Similarity(torch.tensor([2.0]).double(), turn, torch.tensor([[5.0, 6.0, 7.0]]).double())
    there = first.moved_by(space).apply(space.apply(points))
    torch.testing.assert_close(there, space.apply(first.apply(points)))
