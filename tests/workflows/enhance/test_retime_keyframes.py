"""Two keyframes and a length: the motion that is written, its curves, and keyframes that do not fit."""

import csv
from pathlib import Path

import pytest
import torch

from torchface.cli import main
from torchface.errors import FileFormatError, TopologyError, ValueRangeError
from torchface.io import MeshSequence, load_animation, load_rig, save_mesh
from torchface.mesh import Mesh
from torchface.workflows.enhance.retime_keyframes import Keyframe, retime_keyframes


def test_the_motion_goes_from_one_keyframe_to_the_other_by_the_curves(
    actor, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    last = actor.frames[-1]
    save_mesh(actor.mesh.with_vertices(last), tmp_path / "smile.obj")
    words = ["--from", f"{actor.folder / 'weights.csv'}@0", "--rig", actor.folder / "rig.glb"]
    words += ["--to", tmp_path / "smile.obj", "--frames", 9, "--model", actor.model, "--out", tmp_path / "out", "-q"]
    main(["retime", *map(str, words)])
    assert "9 frames, 0.27 s, 30 a second" in capsys.readouterr().err
    frames = MeshSequence(tmp_path / "out" / "retimed.safetensors").read(0, 9)
    torch.testing.assert_close(frames[0], actor.frames[0], rtol=0, atol=1e-3)
    torch.testing.assert_close(frames[-1], last, rtol=0, atol=1e-3)
    animation, rig = load_animation(tmp_path / "out" / "retimed.glb"), load_rig(tmp_path / "out" / "retimed.glb")
    shown = rig(rig.weights_from(animation.weights))
    assert (shown - frames).norm(dim=-1).max() < 0.02  # a target a region gives every frame
    rows = list(csv.DictReader((tmp_path / "out" / "timing.csv").open()))
    curves = torch.tensor([[float(row[name]) for name in rig.names] for row in rows])
    assert bool((curves.diff(dim=0) >= 0).all())
    assert curves[0].max() == 0
    assert curves[-1].min() == 1
    written = ["index.html", "retimed.glb", "retimed.safetensors", "timing.csv", "timing.png"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == written


def test_keyframes_that_do_not_fit_are_named(actor, tmp_path: Path) -> None:
    out, weights, rig = tmp_path / "out", actor.folder / "weights.csv", actor.folder / "rig.glb"
    fine = Keyframe(weights, 3, rig)
    cut, shuffled = tmp_path / "cut.obj", tmp_path / "shuffled.obj"
    save_mesh(Mesh(actor.mesh.vertices, actor.mesh.faces[:-4]), cut)
    order = torch.randperm(len(actor.mesh.vertices), generator=torch.Generator().manual_seed(0))
    save_mesh(actor.mesh.with_vertices(actor.mesh.vertices[order]), shuffled)
    for last, kind, said in (
        (
            Keyframe(weights, 3, rig),
            ValueRangeError,
            r"weights\.csv: found keyframes 3 and 3, expected the first before",
        ),
        (Keyframe(weights, 1, rig), ValueRangeError, "found keyframes 3 and 1"),
        (Keyframe(weights, None, rig), ValueRangeError, "expected the first before"),
        (Keyframe(weights, 99, rig), ValueRangeError, "found no frame 99, expected 0 to 11"),
        (Keyframe(rig), ValueRangeError, "keyframes: found two that are equal"),
        (Keyframe(cut), TopologyError, r"cut\.obj: found .* expected those of the model"),
        (Keyframe(shuffled), TopologyError, "order"),
    ):
        first = Keyframe(weights, 0, rig) if last.path == rig else fine
        with pytest.raises(kind, match=said):
            retime_keyframes(first, last, 8, actor.model, out)
    missing = tmp_path / "missing.obj"
    with pytest.raises(FileFormatError, match=r"missing\.obj: "):
        retime_keyframes(Keyframe(missing), fine, 8, actor.model, out)
    with pytest.raises(ValueRangeError, match="found the same file for both keyframes"):
        retime_keyframes(Keyframe(cut), Keyframe(cut), 8, actor.model, out)
    with pytest.raises(ValueRangeError, match="--frames: found 1, expected a whole number of at least 2"):
        retime_keyframes(Keyframe(cut), fine, 1, actor.model, out)
    assert not out.exists()
