"""The webcam's graph as a file."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchface.workflows.webcam.webcam_export import export_webcam


@pytest.mark.bench
def test_the_exported_file_computes_what_pytorch_does(tmp_path: Path) -> None:
    """Of the same networks and solver, from the same states; it takes half a minute to make."""
    report = export_webcam(tmp_path / "webcam.onnx")
    print(f"\n{report.rows()}")
    assert report.landmarks < 2e-3
    assert report.weights < 0.02
    assert report.path.stat().st_size == report.size < 4e6
