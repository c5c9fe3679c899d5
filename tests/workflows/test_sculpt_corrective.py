"""The command `corrective`: from a pose's mesh and an artist's change of it to a rig's file that shows it."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from rig_samples import corrective_sheet, sheet_take

from torchface.cli import main
from torchface.io import load_animation, load_mesh, load_rig, save_animation, save_mesh

POSE = ("jawOpen=0.7", "eyeBlinkRight=0.5")


@pytest.mark.parametrize("ending", [".glb", ".usdc", ""])
def test_a_sculpt_becomes_a_corrective_in_every_kind_of_file(
    ending: str, tmp_path: Path, messages_of: Callable[..., str]
) -> None:
    rig, source, out = corrective_sheet(), tmp_path / "rig.glb", tmp_path / f"out{ending}"
    save_animation(rig, sheet_take(), source)
    posed = str(tmp_path / "posed.obj")
    main(["convert", str(source), posed, "--at", *POSE])
    mesh = load_mesh(posed)
    weights = torch.tensor([[0.7, 0.0, 0.5]])
    assert (mesh.vertices - rig(weights)[0]).abs().max() < 1e-4
    lifted = mesh.vertices.clone()
    lifted[3:9, 2] += 1.5
    save_mesh(mesh.with_vertices(lifted), posed)
    command = ["corrective", str(source), "--at", " ".join(POSE), "--sculpt", posed, "--out", str(out)]
    told = messages_of(*command, "--name", "open_blink")
    assert "open_blink (jawOpen x eyeBlinkRight): the sculpt changes 6 of 30 vertices, by up to 1.5 mm" in told
    found = load_rig(out)
    assert found.correctives.names[-1] == "open_blink"
    assert set(found.correctives.names) == {*rig.correctives.names, "open_blink"}
    assert (found(weights)[0] - lifted).abs().max() < 2e-4
    assert (found(torch.eye(3)) - rig(torch.eye(3))).abs().max() < 1e-3
    if ending:
        assert len(load_animation(out)) == 5
        with pytest.raises(SystemExit):
            main(["corrective", str(out), "--at", *POSE, "--sculpt", posed, "--out", str(tmp_path / "again.glb")])
        assert not (tmp_path / "again.glb").exists()
    save_mesh(mesh.with_vertices(lifted + 1), posed)
    assert "--align remove takes that out" in messages_of(*command[:-1], tmp_path / "moved.glb", status=2)
