"""The webcam's graph as a file, and what of it an interrupted start keeps."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace

import onnx
import pytest
from onnx import helper

from torchface.workflows.webcam import webcam_graph as module
from torchface.workflows.webcam.webcam_export import export_webcam


def test_a_start_that_is_interrupted_keeps_the_part_that_is_ready(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, said, empty = list[str](), list[tuple[int, int]](), helper.make_model(helper.make_graph([], "g", [], []))

    def part(name: str) -> onnx.ModelProto:
        made.append(name)
        if made.count("search") == 1 and name == "search":
            raise KeyboardInterrupt
        return empty

    monkeypatch.setenv("TORCHFACE_CACHE", str(tmp_path))
    monkeypatch.setattr(module, "default_webcam_solver", lambda: None)
    monkeypatch.setattr(module, "WebcamSolverGraph", lambda solver: SimpleNamespace(state_size=2))
    monkeypatch.setattr(module, "FaceReader", lambda networks: networks)
    monkeypatch.setattr(module, "solving_model", lambda solver: part("solving"))
    parts = {name: partial(part, name) for name in ("look", "search")}
    monkeypatch.setattr(module, "reading_parts", lambda reader: parts)
    monkeypatch.setattr(module, "reading_model", lambda reader, size, parts: part("reading"))
    monkeypatch.setattr(module, "webcam_model", lambda reading, solving, facts: part("whole"))
    with pytest.raises(KeyboardInterrupt):
        module.webcam_graph(lambda step, done=0, total=0: said.append((done, total)))
    assert module.webcam_graph() == module.webcam_graph() == empty.SerializeToString()
    assert made == ["solving", "look", "search", "search", "reading", "whole"]
    assert sorted(set(said)) == [(0, 4), (1, 4), (2, 4)]


@pytest.mark.bench
def test_the_exported_file_computes_what_pytorch_does(tmp_path: Path) -> None:
    """Of the same networks and solver, from the same states; it takes half a minute to make."""
    report = export_webcam(tmp_path / "webcam.onnx")
    print(f"\n{report.rows()}")
    assert report.landmarks < 2e-3
    assert report.weights < 0.02
    assert report.path.stat().st_size == report.size < 5e6
