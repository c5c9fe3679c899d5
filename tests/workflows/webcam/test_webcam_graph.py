"""The webcam's graph is made once, and anew where what was kept is damaged or what it is made of has changed."""

from __future__ import annotations

from pathlib import Path

import pytest
from onnx import TensorProto, helper

from torchface.files.content_keys import content_key
from torchface.workflows.webcam import webcam_graph as module
from torchface.workflows.webcam.webcam_export import export_webcam


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A cache of its own, and a note of every graph that is made."""
    notes: list[str] = []
    end = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1])
    start = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1])
    model = helper.make_model(helper.make_graph([helper.make_node("Identity", ["x"], ["y"])], "g", [start], [end]))

    def planted(*parts: object, facts: dict[str, object]) -> object:
        notes.append(str(facts["licence"]))
        return model

    monkeypatch.setenv("TORCHFACE_CACHE", str(tmp_path))
    for name in ("webcam_networks", "default_webcam_solver"):
        monkeypatch.setattr(module, name, lambda: None)
    monkeypatch.setattr(module, "webcam_solver_model", lambda solver: solver)
    monkeypatch.setattr(module, "webcam_model", planted)
    return notes


def test_it_is_made_once(made: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = module.webcam_graph()
    assert module.webcam_graph() == content
    assert made == ["MIT"]
    (path,) = tmp_path.rglob("*.onnx")
    path.write_bytes(content[:-1])  # damaged
    assert module.webcam_graph() == content
    assert path.read_bytes() == content
    assert len(made) == 2
    path.with_suffix(".sha256").unlink()
    assert module.webcam_graph() == content
    assert len(made) == 3
    monkeypatch.setattr(module, "content_key", lambda method, **inputs: content_key(f"{method}, later", **inputs))
    module.webcam_graph()
    assert len(made) == 4


@pytest.mark.bench
def test_the_exported_file_computes_what_pytorch_does(tmp_path: Path) -> None:
    """Of the same networks and solver, from the same states; it takes half a minute to make."""
    report = export_webcam(tmp_path / "webcam.onnx")
    print(f"\n{report.rows()}")
    assert report.landmarks < 2e-3
    assert report.weights < 0.02
    assert report.path.stat().st_size == report.size < 4e6
