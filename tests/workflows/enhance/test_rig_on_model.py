"""Poses of a rig of another topology on a model's dense mesh."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.workflows.enhance.conftest import Actor
from torchface import BlendshapeRig, Mesh
from torchface.errors import AlignmentError, ShapeError
from torchface.geometry.rotations import rotation_matrix
from torchface.progress import silent
from torchface.workflows.enhance.rig_on_model import RigOnModel, rig_on_model


@pytest.fixture(scope="module")
def model(actor: Actor) -> Mesh:
    return Mesh(actor.mesh.vertices, actor.mesh.faces)


@pytest.fixture(scope="module")
def pairs(actor: Actor, tmp_path_factory: pytest.TempPathFactory) -> tuple[BlendshapeRig, Path]:
    """The rig without its lowest fifth, turned and moved, and where 150 of its vertices lie on the model."""
    heights = actor.rig.vertices[:, 1]
    keep = heights > heights.quantile(0.2)
    part = actor.rig.part(keep)
    turn, place = rotation_matrix(torch.tensor([0.2, -0.5, 0.1])), torch.tensor([30.0, -200.0, 15.0])
    neutral = replace(part.neutral, vertices=part.vertices @ turn.T + place)
    own = keep.nonzero()[:, 0]
    rows = torch.linspace(0, len(own) - 1, 150).round().long()
    path = tmp_path_factory.mktemp("pairs") / "pairs.csv"
    lines = [f"{row},{int(own[row])}" for row in rows.tolist()]
    path.write_text("\n".join(["input,model", *lines, ""]))
    return BlendshapeRig(neutral, part.deltas @ turn.T, part.names), path


@pytest.fixture(scope="module")
def placed(pairs: tuple[BlendshapeRig, Path], model: Mesh, tmp_path_factory: pytest.TempPathFactory) -> RigOnModel:
    rig, path = pairs
    return rig_on_model(
        rig, Path("part.glb"), model, path, tmp_path_factory.mktemp("kept") / "found.safetensors", silent
    )


def test_poses_of_another_topology_reach_the_dense_mesh(actor: Actor, placed: RigOnModel) -> None:
    heights = actor.rig.vertices[:, 1]
    shown = heights > heights.quantile(0.25)
    weights = actor.weights[[0, -1]]
    dense = placed.dense(placed.rig(weights))
    apart = (dense - actor.rig(weights)).norm(dim=-1)[:, shown]
    moved = (actor.rig(weights[1:]) - actor.rig.vertices).norm(dim=-1)[0, shown]
    assert float(apart[0].square().mean().sqrt()) < 0.05
    assert float(apart[1].square().mean().sqrt()) < 0.15 * float(moved.square().mean().sqrt())
    assert placed.scale == pytest.approx(1, abs=1e-3)


def test_what_the_model_has_at_its_vertices_is_read_at_the_rigs(actor: Actor, placed: RigOnModel, model: Mesh) -> None:
    values = model.vertices.T
    torch.testing.assert_close(placed.carried(values, model).T, placed.neutral.vertices, atol=0.05, rtol=0)
    sites = placed.sites()
    assert len(sites.unique()) == len(sites)
    assert bool(placed.correspondence.known[sites].all())


def test_a_rig_of_another_size_is_refused(actor: Actor, model: Mesh, tmp_path: Path) -> None:
    large = BlendshapeRig(actor.mesh.with_vertices(10 * actor.rig.vertices), 10 * actor.rig.deltas, actor.rig.names)
    with pytest.raises(AlignmentError, match=r"large\.glb"):
        rig_on_model(large, Path("large.glb"), model, None, tmp_path / "found.safetensors", silent)
    few = tmp_path / "few.csv"
    few.write_text("input,model\n1,1\n2,2\n")
    part = actor.rig.part(torch.arange(2000))
    with pytest.raises(ShapeError, match=r"few\.csv: found 2 pairs"):
        rig_on_model(part, Path("part.glb"), model, few, tmp_path / "found.safetensors", silent)
