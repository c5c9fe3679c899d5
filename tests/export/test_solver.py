"""``python -m export.solver`` exports a rig on disk with the markers of a file."""

from pathlib import Path

import pytest

import export.solver as module
from torchface import Attachment, BlendshapeRig, save_rig


def test_rig_and_attachment_of_files_are_exported(
    dome_rig: BlendshapeRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The export itself is tried by ``tests/onnx/test_solver_graph_export.py``."""
    given: list[tuple[tuple[str, ...], tuple[str, ...] | None, Path]] = []

    def exported(rig: BlendshapeRig, attachment: Attachment, out: Path) -> str:
        given.append((rig.names, attachment.labels, out))
        return "30% missing"

    monkeypatch.setattr(module, "export_solver", exported)
    save_rig(dome_rig, tmp_path / "rig.glb")
    attachment = Attachment.from_vertices(dome_rig.neutral, range(0, 600, 9))
    attachment.save(tmp_path / "attachment.json")
    module.solver(tmp_path / "rig.glb", tmp_path / "attachment.json", tmp_path / "solver.onnx")
    assert given == [(dome_rig.names, attachment.labels, tmp_path / "solver.onnx")]
    assert capsys.readouterr().out == "30% missing\n"
