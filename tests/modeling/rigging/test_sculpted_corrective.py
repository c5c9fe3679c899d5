"""Correctives from sculpts: exact at the pose, nothing where a driver is off, refused where they do not fit."""

import re

import pytest
import torch
from torch import Tensor

from planted.planted_correctives import planted_correctives
from torchface import BlendshapeRig, Corrective, Mesh, TorchfaceError
from torchface.errors import AlignmentError, NameMismatchError, TopologyError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.modeling import corrective_from_sculpt
from torchface.modeling.rigging.sculpted_corrective import checked_sculpt
from torchface.synthetic import performer

NAMES = ("jawOpen", "mouthSmileLeft", "mouthPucker", "browInnerUp", "eyeBlinkLeft")


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    linear = performer(texture=False).select(NAMES)
    return BlendshapeRig(linear.neutral, linear.deltas, NAMES, planted_correctives(linear, 6))


def pose(**weights: float) -> Tensor:
    return torch.tensor([weights.get(name, 0.0) for name in NAMES])


def bump(rig: BlendshapeRig, weights: Tensor) -> Tensor:
    """The face at a pose with the left corner of the mouth pulled out, as by a brush."""
    face = rig(weights[None])[0]
    corner = rig.vertices[rig.neutral.annotations.landmarks[54]]
    near = torch.exp(-(rig.vertices - corner).square().sum(-1) / (2 * 12.0**2))
    return face + torch.where(near > 0.01, 3 * near, 0.0)[:, None] * torch.tensor([0.6, 0.0, 0.8])


@pytest.mark.parametrize(
    "weights",
    [
        pose(jawOpen=0.7, mouthSmileLeft=1.0),
        pose(jawOpen=0.7, mouthSmileLeft=0.9, mouthPucker=0.8),
        pose(jawOpen=0.6, mouthSmileLeft=0.9, mouthPucker=0.8, browInnerUp=0.7),
        pose(browInnerUp=0.45),
    ],
)
def test_the_rig_shows_the_sculpt_at_the_pose_and_is_unchanged_elsewhere(rig: BlendshapeRig, weights: Tensor) -> None:
    drivers = {NAMES[row] for row in weights.nonzero()[:, 0].tolist()}
    taken = any(set(one.drivers) == drivers for one in rig.correctives.definitions if len(drivers) > 1)
    sculpt = bump(rig, weights)
    made = corrective_from_sculpt(rig, weights, sculpt, replace=taken)
    assert (made.rig(weights[None])[0] - sculpt).abs().max() < 1e-4
    still = torch.cat([torch.zeros(1, 5), torch.eye(5)])
    torch.testing.assert_close(made.rig(still), rig(still))
    if len(drivers) > 1:  # a driver that is off turns it off
        others = torch.rand(5, 5, generator=torch.Generator().manual_seed(1))
        for row in weights.nonzero()[:, 0].tolist():
            others[:, row] = 0
            torch.testing.assert_close(made.rig(others), rig(others), atol=2e-4, rtol=0)
            others[:, row] = 0.5
    assert "the sculpt changes" in made.lines()[0]
    assert "by up to 3 mm" in made.lines()[0]
    assert "corner" in made.lines()[0] or "lip" in made.lines()[0] or "mouth" in made.lines()[0]


def test_a_new_in_between_leaves_the_faces_at_the_other_peaks(rig: BlendshapeRig) -> None:
    first = corrective_from_sculpt(rig, pose(jawOpen=0.5), bump(rig, pose(jawOpen=0.5)), replace=True)
    at = pose(jawOpen=0.25)
    second = corrective_from_sculpt(first.rig, at, rig(at[None])[0] + torch.tensor([0.0, 0.0, 1.0]))
    assert second.definition == Corrective("jawOpen_25", ("jawOpen",), 0.25)
    peaks = torch.stack([pose(), pose(jawOpen=0.5), pose(jawOpen=1.0)])
    torch.testing.assert_close(second.rig(peaks), first.rig(peaks), atol=1e-4, rtol=0)


def test_a_corrective_is_replaced_only_on_request(rig: BlendshapeRig) -> None:
    weights = pose(jawOpen=0.7, eyeBlinkLeft=1.0)
    made = corrective_from_sculpt(rig, weights, bump(rig, weights), "open_blink", replace=True)
    other = pose(eyeBlinkLeft=0.5, jawOpen=0.5)
    with pytest.raises(NameMismatchError, match=r"found 'open_blink', which acts at .*--replace"):
        corrective_from_sculpt(made.rig, other, bump(made.rig, other))
    again = corrective_from_sculpt(made.rig, other, bump(made.rig, other), replace=True)
    assert again.definition.name == "open_blink"
    assert len(again.rig.correctives.names) == len(made.rig.correctives.names)
    assert (again.rig(other[None])[0] - bump(made.rig, other)).abs().max() < 1e-4
    assert "is 0.25 on at this pose" in again.lines()[1]
    more = pose(jawOpen=1.0, eyeBlinkLeft=1.0, browInnerUp=1.0)
    three = corrective_from_sculpt(again.rig, more, bump(again.rig, more), "three", replace=True)
    assert "poses of three" in corrective_from_sculpt(three.rig, other, bump(three.rig, other), None, True).lines()[-1]


def test_a_mesh_of_another_pose_is_warned_of(rig: BlendshapeRig) -> None:
    weights = pose(jawOpen=0.7, mouthPucker=1.0)
    made = corrective_from_sculpt(rig, weights, rig(pose(jawOpen=0.2, mouthPucker=1.0)[None])[0], replace=True)
    assert any("jawOpen-0.5" in line and "another pose" in line for line in made.lines())


def test_a_mesh_of_the_other_side_is_warned_of() -> None:
    rig = performer(texture=False).select(("jawOpen", "mouthSmileLeft", "mouthSmileRight"))
    left, right = torch.tensor([0.7, 1.0, 0.0]), torch.tensor([0.7, 0.0, 1.0])
    warning = next(x for x in corrective_from_sculpt(rig, left, bump(rig, right)).lines() if "another pose" in x)
    assert re.search(r"mouthSmileLeft-(1.0|0.9)\d mouthSmileRight\+(1.0|0.9)\d", warning)
    assert not any("another pose" in x for x in corrective_from_sculpt(rig, left, bump(rig, left)).lines())


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (pose(), "found no weight"),
        (pose(jawOpen=1.0), "is the shape itself"),
        (pose(jawOpen=1.5, mouthPucker=1.0), "at most 1"),
        (pose(jawOpen=0.7, mouthPucker=1.0), "expected a change of it"),
    ],
)
def test_poses_without_a_corrective_are_refused(rig: BlendshapeRig, weights: Tensor, message: str) -> None:
    sculpt = rig.without_correctives()
    with pytest.raises(ValueRangeError, match=message):
        corrective_from_sculpt(sculpt, weights, sculpt(weights[None])[0])


def test_sculpts_of_other_meshes_are_refused_and_a_motion_is_removed_on_request(rig: BlendshapeRig) -> None:
    weights = pose(jawOpen=0.7, mouthSmileLeft=1.0)
    shown, sculpt = rig(weights[None])[0], bump(rig, weights)

    def taken(vertices: Tensor, align: str | None = None) -> Tensor:
        mesh = Mesh.from_polygons(vertices, rig.neutral.polygons)
        return checked_sculpt("posed.obj", mesh, rig, shown, align)

    assert torch.equal(taken(sculpt), sculpt)
    moved = 1.002 * sculpt @ rotation_matrix(torch.tensor([[0.0, 0.01, 0.0]]))[0].T + torch.tensor([0.0, 2.0, 1.0])
    with pytest.raises(AlignmentError, match=r"moved by 2\.\d+ mm, turned by 0.57 degrees and scaled by 1.002"):
        taken(moved)
    assert (taken(moved, "remove") - sculpt).abs().max() < 1e-3
    for kept in (moved, moved + 60.0):  # however far
        assert torch.equal(taken(kept, "keep"), kept)
    order = torch.randperm(len(sculpt), generator=torch.Generator().manual_seed(1))
    for mesh, message in (
        (Mesh.from_polygons(sculpt[order], order.argsort()[rig.neutral.polygons]), "its order of vertices"),
        (Mesh(sculpt[:-1], rig.neutral.faces[:5] * 0), r"found 6,418 vertices, expected the rig's 6,419"),
    ):
        with pytest.raises(TopologyError, match=message):
            checked_sculpt("posed.obj", mesh, rig, shown, None)
    for scale in (0.1, 1e-3):
        with pytest.raises(TorchfaceError, match=r"--unit c?m"):
            taken(scale * sculpt)
    with pytest.raises(TopologyError, match="half of the vertices"):
        taken(sculpt * torch.tensor([-1.0, 1.0, 1.0]) + 20, "keep")
