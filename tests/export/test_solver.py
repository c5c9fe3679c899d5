"""``python -m export.solver`` writes a file that the example runs with onnxruntime and numpy alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchface import Attachment, BlendshapeRig, load_rig
from torchface.capture import MarkerSolver

REPOSITORY = Path(__file__).resolve().parents[2]
# Importing torch would defeat the example's point, so it is made impossible.
_WITHOUT_TORCH = "import sys, runpy; sys.modules['torch'] = None; sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0])"


def _obj(path: Path, vertices: torch.Tensor) -> None:
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices.tolist()]
    path.write_text("\n".join([*lines, "f 1 2 3", "f 1 3 4", "f 1 4 5", "f 1 5 2"]) + "\n")


@pytest.fixture
def rig_folder(tmp_path: Path) -> Path:
    """A pyramid with three shapes, as OBJ files."""
    folder = tmp_path / "rig"
    folder.mkdir()
    neutral = torch.tensor([[0.0, 0, 20], [-20, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]])
    _obj(folder / "neutral.obj", neutral)
    generator = torch.Generator().manual_seed(0)
    for name in ("open", "smile", "frown"):
        _obj(folder / f"{name}.obj", neutral + 5 * torch.randn(5, 3, generator=generator))
    return folder


def performed(rig: BlendshapeRig, attachment: Attachment) -> tuple[torch.Tensor, torch.Tensor]:
    weights = torch.rand(30, 3, generator=torch.Generator().manual_seed(1))
    markers = attachment.on(rig.neutral.faces, rig(weights))
    markers[4, 2] = torch.nan
    return weights, markers


def test_from_a_rig_on_disk_to_weights_without_torch(rig_folder: Path, tmp_path: Path) -> None:
    rig = load_rig(rig_folder)
    attachment = Attachment.from_vertices(rig.neutral, range(5))
    attachment.save(tmp_path / "attachment.json")
    out = tmp_path / "solver.onnx"
    arguments = ["--rig", rig_folder, "--attachment", tmp_path / "attachment.json", "--out", out]
    done = subprocess.run(
        [sys.executable, "-m", "export.solver", *map(str, arguments)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "30% missing" in done.stdout
    assert out.is_file()

    weights, markers = performed(rig, attachment)
    np.save(tmp_path / "markers.npy", markers.numpy())
    example = [REPOSITORY / "examples" / "solve_onnx.py", out, tmp_path / "markers.npy", tmp_path / "weights.npy"]
    done = subprocess.run(
        [sys.executable, "-c", _WITHOUT_TORCH, *map(str, example)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "30 frames" in done.stdout
    solved = torch.from_numpy(np.load(tmp_path / "weights.npy"))
    torch.testing.assert_close(solved, MarkerSolver(rig, attachment)(markers), rtol=0, atol=1e-3)
    assert (solved - weights).abs().max() < 0.05
