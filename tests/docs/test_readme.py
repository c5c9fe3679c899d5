"""The Python of the README and of a how-to page runs when it is pasted."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchface import Attachment, Take, Track, save_rig, save_take
from torchface.geometry.rotations import rotation_matrix
from torchface.io import load_animation
from torchface.synthetic import performer

README = Path(__file__).resolve().parents[2] / "README.md"


def test_the_first_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(code, str(README), "exec"), names)
    smiles = names["solved"].weights.select(["mouthSmileLeft"]).values[:, 0, 0]
    assert abs(float(smiles[-1]) - 1) < 0.05
    take = load_animation(tmp_path / "smile.glb")
    assert len(take) == 60


@pytest.mark.parametrize(
    ("angle", "way", "stated"), [(0.05, 4.0, True), (0.7, 300.0, True), (0.7, 300.0, False)], ids=str
)
def test_the_markers_for_a_graph_are_brought_into_the_rigs_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, angle: float, way: float, stated: bool
) -> None:
    """Of a helmet that slips, and of a head that moves in the volume, whose scale may be estimated, too; with labels as
    a recorder writes them, of which one marker has none."""
    monkeypatch.chdir(tmp_path)
    page = README.parent / "docs" / "how_to" / "applications.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    assert ", scale=False)" in code
    code = code if stated else code.replace(", scale=False)", ")")
    actor = performer(texture=False).select(["jawOpen", "mouthSmileLeft", "mouthSmileRight"])
    sites = Attachment.from_vertices(actor.neutral, actor.neutral.landmarks[17:])
    markers = sites.on(actor.neutral.faces, actor(torch.rand(20, 3, generator=torch.Generator().manual_seed(0))))
    turn = torch.tensor([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    labels, order = list(sites.labels), torch.arange(1, len(sites.labels)).flip(0)
    save_rig(actor, "actor.glb")
    sites.save("attachment.json")
    phase = torch.linspace(0, 6, len(markers))
    slip = rotation_matrix(angle * torch.stack([phase.sin(), phase.cos(), 0 * phase], 1))
    slid = markers @ slip.transpose(1, 2) + way * torch.stack([phase.sin(), 0 * phase, phase.cos()], 1)[:, None]
    moved = Track([f"Jane:{labels[i]}" for i in order], slid[:, order] @ turn.T + torch.tensor([90.0, -1200.0, 40.0]))
    save_take(Take(30.0, markers=moved), "take.c3d")
    exec(compile(code, str(page), "exec"), {})
    written = torch.from_numpy(np.load("markers.npy"))
    assert torch.isnan(written[:, 0]).all()
    assert float((written - markers)[:, 1:].norm(dim=-1).max()) < 0.2
