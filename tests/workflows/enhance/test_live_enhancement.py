"""A live session's takes with an actor's wrinkles."""

from pathlib import Path

import pytest
import torch
from planted_faces import ShadeSolver, film

from tests.workflows.enhance.conftest import Actor
from torchface.errors import NameMismatchError
from torchface.io import MeshSequence
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.workflows.enhance.enhance_animation import load_model
from torchface.workflows.live.live_anybody import LiveSettings, go_live


@pytest.mark.bench
def test_a_take_gets_the_models_wrinkles(actor: Actor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    played, said = film(tmp_path / "film.avi", [0.0, 0.4, 0.8]), list[str]()
    settings = LiveSettings(
        str(played), actor.folder / "rig.glb", record=tmp_path / "out", page=False, enhance=actor.model
    )
    _, (take,) = go_live(settings, said.append, print, ShadeSolver)
    moved = read_gltf_weights(take.folder / "animation.glb")
    assert moved is not None
    assert moved.weights is not None
    coarse = actor.rig(moved.weights.select(actor.rig.names).values[..., 0])
    expected = load_model(actor.model)(coarse)
    assert float((expected - coarse).norm(dim=-1).max()) > 0.05
    found = MeshSequence(take.folder / "enhanced" / "enhanced.safetensors")
    torch.testing.assert_close(found.read(0, len(coarse)), expected, atol=2e-3, rtol=0)
    assert f"{take.frames} frames of" in " ".join(said)


def test_a_model_that_is_none_is_said_before_the_take(tmp_path: Path) -> None:
    settings = LiveSettings("0", page=False, enhance="face_boxes")
    with pytest.raises(NameMismatchError, match="expected an EnhancementModel"):
        go_live(settings, print, print, ShadeSolver)
