"""A retimed animation is read piece by piece and is the same as in one."""

from pathlib import Path

import pytest
import torch

from tests.workflows.enhance.conftest import Actor, folded
from torchface import zoo
from torchface.enhancement import CapturedPerformance, EnhancementModel, EnhancementSettings
from torchface.enhancement.animation_retiming import at_moments, retimed_moments
from torchface.io.meshes.mesh_sequence import MeshSequenceWriter
from torchface.progress import silent
from torchface.workflows.enhance import enhanced_frames
from torchface.workflows.enhance.coarse_input import InputSettings, read_coarse
from torchface.workflows.enhance.enhance_views import framed_model


def test_pieces_are_those_of_the_whole(actor: Actor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = zoo.get_model(Path(actor.model))
    assert isinstance(model, EnhancementModel)
    frames = actor.frames
    path = tmp_path / "meshes.safetensors"
    with MeshSequenceWriter(path, len(frames), frames.shape[1], actor.mesh.faces) as writer:
        writer.append(frames)
    monkeypatch.setattr(enhanced_frames, "piece_size", lambda vertices: 5)
    given = read_coarse(path, actor.mesh, InputSettings(), tmp_path, silent)
    found = enhanced_frames.retimed_animation(given, model, silent)
    with torch.no_grad():
        moments = retimed_moments(model, model.features(frames), given.fps)
        whole = at_moments(frames, moments, model.vertex_weights)
    pieces = torch.cat([found.read(0, 4), found.read(4, len(frames))])
    torch.testing.assert_close(pieces, whole, atol=2e-3, rtol=0)
    torch.testing.assert_close(pieces[[0, -1]], frames[[0, -1]], atol=2e-3, rtol=0)
    assert float((pieces - frames).abs().max()) > 0.01
    assert "retimed" in found.notes[-1]


def test_a_model_of_gradients_is_framed_where_one_of_displacements_is(actor: Actor) -> None:
    frames = folded(actor.frames, actor.mesh.vertices)
    captured = CapturedPerformance(frames, actor.mesh.faces, torch.arange(len(frames)) // 4, actor.mesh.vertices)
    seen = [
        framed_model(EnhancementModel.fit(captured, EnhancementSettings(detail=kind), rank=4)).annotations
        for kind in ("displacements", "gradients")
    ]
    one, other = (notes.regions["face"] for notes in seen)
    assert float((one & other).sum() / (one | other).sum()) > 0.5
    assert float((one | other).double().mean()) < 0.9


def test_the_report_says_which_region_moved_in_time_and_how_far() -> None:
    shifts = torch.tensor([[0.0, 0.1, 0.0, 0.0], [0.0, 0.3, 0.2, 0.0]])
    note = enhanced_frames.shift_note(shifts, ("brow", "mouth"))
    assert "50% of the frames" in note
    assert "0.20 s away in the mean" in note
    assert "0.30 s (mouth)" in note
    assert "no motion" in enhanced_frames.shift_note(torch.zeros(2, 4), ("brow", "mouth"))
