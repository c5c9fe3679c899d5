"""Meshes of another order of vertices are laid on the model; what is wrong with them is named."""

import re
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.workflows.enhance.conftest import FRAMES, Actor, coarse, shuffled, written
from torchface import Mesh
from torchface.errors import ValueRangeError
from torchface.geometry.similarity import similarity_transform
from torchface.io import Correspondences, save_correspondences
from torchface.registration import Registration
from torchface.workflows.enhance import head_correspondence


@pytest.mark.parametrize("ending", ["csv", "json"])
def test_pairs_lay_another_topology_on_the_model(actor: Actor, tmp_path: Path, ending: str) -> None:
    order, faces = shuffled(actor)
    path = written(tmp_path / "other.safetensors", actor.frames[:, order] + torch.tensor([5.0, -90.0, 0.0]), faces)
    chosen = torch.arange(0, len(order), 9)
    pairs = tmp_path / f"pairs.{ending}"
    if ending == "csv":
        rows = [f"{i},{int(order[i])}" for i in chosen.tolist()]
        pairs.write_text("\n".join(["input,model", *rows]))
    else:
        labels = tuple(f"p{i}" for i in chosen.tolist())
        save_correspondences(Correspondences(chosen, actor.mesh.vertices[order[chosen]], labels), pairs)
    found = coarse(actor, path, tmp_path, pairs=pairs)
    error = found.read(0, FRAMES) - actor.frames
    assert float(error.norm(dim=-1).mean()) < 0.1
    assert "pairs of pairs" in " ".join(found.notes)


def test_a_first_frame_that_is_not_at_rest_is_named_with_one_that_is(actor: Actor, tmp_path: Path) -> None:
    order, faces = shuffled(actor)
    pairs = tmp_path / "pairs.csv"
    pairs.write_text("\n".join(["input,model", *(f"{i},{order[i]}" for i in range(0, len(order), 9))]))
    said = []
    for name, frames in (("rest", actor.frames), ("moved", actor.frames.flip(0))):
        path = written(tmp_path / f"{name}.safetensors", frames[:, order], faces)
        said.append(" ".join(coarse(actor, path, tmp_path, pairs=pairs).notes))
    words = r"warning: moved.safetensors is taken to be at rest in its first frame, \d\.\d mm from the model's head"
    assert re.search(words + rf" at rest, but frame {FRAMES - 1} is \d\.\d mm from it: .*\(--rig\)", said[1])
    assert "warning" not in said[0]


@pytest.mark.parametrize(("other", "way"), [(False, 866.0), (True, 866.0), (False, 30.0)])
def test_a_vertex_that_is_astray_in_one_frame_is_named(actor: Actor, tmp_path: Path, other: bool, way: float) -> None:
    order, faces = shuffled(actor)
    frames = actor.frames.clone()
    frames[7, order[300], 1] += way
    pairs = tmp_path / "pairs.csv"
    pairs.write_text("\n".join(["input,model", *(f"{i},{order[i]}" for i in range(0, len(order), 9))]))
    path = tmp_path / "astray.safetensors"
    if other:
        found = coarse(actor, written(path, frames[:, order], faces), tmp_path, pairs=pairs)
    else:
        found = coarse(actor, written(path, frames, actor.mesh.faces), tmp_path)
    assert torch.isfinite(found.read(0, 7)).all()
    vertex = 300 if other else int(order[300])
    with pytest.raises(ValueRangeError, match=rf"vertex {vertex} in frame 7 \d+ mm farther .* \(1 of {len(order)}"):
        found.read(4, FRAMES)


def test_registration_is_asked_once(actor: Actor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    order, faces = shuffled(actor)
    path = written(tmp_path / "other.safetensors", actor.frames[:, order], faces)
    asked = []

    def register(head: Mesh, model: Mesh, *rest: Any, **more: Any) -> Registration:
        asked.append(len(head.vertices))
        laid = model.vertices[order]
        pose = similarity_transform(head.vertices[None].double(), laid[None].double())
        known = torch.ones(len(laid), dtype=torch.bool)
        return Registration(Mesh(laid, head.faces), pose, torch.zeros(len(laid)), known, None)

    monkeypatch.setattr(head_correspondence, "register", register)
    for _ in range(2):
        found = coarse(actor, path, tmp_path)
        error = (found.read(0, FRAMES) - actor.frames).norm(dim=-1)
        assert float(error.mean()) < 0.1
        assert float(error.max()) < 3.0  # closed lips and lids move their own way
    assert asked == [len(order)]
