"""Commands take USD wherever they take a ``.glb``."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from reading_here import same_process  # noqa: F401

from torchface import Annotations, BlendshapeRig, Take, Track, load_rig, save_animation, save_mesh
from torchface.cli import main
from torchface.errors import ValueRangeError
from torchface.io import load_animation
from torchface.registration import load_scan_landmarks
from torchface.workflows.animated_meshes import load_animated
from torchface.workflows.batch.batch_items import SCAN_ENDINGS
from torchface.workflows.posed_mesh import load_posed
from torchface.workflows.register.register_scans import load_template_mesh

pytestmark = pytest.mark.usefixtures("same_process")


@pytest.fixture
def shot(dome_rig: BlendshapeRig, tmp_path: Path) -> Path:
    """An animated USD file of the dome."""
    values = torch.linspace(0, 1, 6 * len(dome_rig.names)).reshape(6, -1, 1)
    save_animation(dome_rig, Take(25.0, weights=Track(dome_rig.names, values)), tmp_path / "shot.usdc")
    return tmp_path / "shot.usdc"


def test_info_tells_shapes_and_animation(shot: Path, dome_rig: BlendshapeRig, messages_of: Callable[..., str]) -> None:
    told = messages_of("info", shot)
    assert "6 frames at 25 a second" in told
    assert all(name in told for name in dome_rig.names)


def test_transfer_and_retarget_go_from_usd_to_usd(
    shot: Path, dome_rig: BlendshapeRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_mesh(dome_rig.neutral.with_vertices(dome_rig.vertices * 1.1), tmp_path / "neutral.usda")
    main(["transfer", str(shot), str(tmp_path / "neutral.usda"), "--out", str(tmp_path / "actor.usdz")])
    actor = load_rig(tmp_path / "actor.usdz")
    assert actor.names == dome_rig.names
    assert (actor.vertices - 1.1 * dome_rig.vertices).abs().max() < 1e-3
    (tmp_path / "w.csv").write_text("frame,time," + dome_rig.names[0] + "\n0,0.0,0.5\n1,0.1,1\n")
    words = ["--to", str(tmp_path / "actor.usdz"), "--out", str(tmp_path / "o.csv")]
    main(["retarget", str(tmp_path / "w.csv"), *words, "--animation", str(tmp_path / "moved.usda")])
    assert load_animation(tmp_path / "moved.usda").weights.values[:, 0, 0].tolist() == [0.5, 1]
    assert capsys.readouterr().out.split()[-2:] == [str(tmp_path / "o.csv"), str(tmp_path / "moved.usda")]


def test_an_ending_without_animation_is_refused_before_any_work(
    shot: Path, tmp_path: Path, messages_of: Callable[..., str]
) -> None:
    (tmp_path / "w.csv").write_text("frame,time,jawOpen\n0,0.0,0.5\n")
    words = ["--to", str(shot), "--out", str(tmp_path / "o.csv"), "--animation", str(tmp_path / "moved.obj")]
    assert "found the ending '.obj', expected .glb, .usd, .usda" in messages_of(
        "retarget", tmp_path / "w.csv", *words, status=2
    )
    assert not (tmp_path / "o.csv").exists()


def test_meshes_over_time_poses_and_templates(shot: Path, dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    moved = load_animated(shot)
    assert moved.count == 6
    assert moved.fps == 25
    weights = load_animation(shot).weights.values[..., 0]
    assert (moved.read(0, 6) - dome_rig(weights)).abs().max() < 1e-3
    posed = load_posed(shot, {dome_rig.names[0]: 0.5})
    assert (posed.mesh.vertices - dome_rig.vertices - 0.5 * dome_rig.deltas[0]).abs().max() < 1e-3
    assert (load_template_mesh(shot).vertices - dome_rig.vertices).abs().max() < 1e-3
    assert ".usdc" in SCAN_ENDINGS


def test_points_beside_a_usd_scan_need_their_unit(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    template = replace(dome_rig.neutral, annotations=Annotations(landmarks=torch.tensor([0, 1, 2])))
    (tmp_path / "scan.pts").write_text("version: 1\nn_points: 3\n{\n0 0 1\n1 0 0\n0 1 0\n}\n")
    with pytest.raises(ValueRangeError, match="points beside a USD file, expected their unit"):
        load_scan_landmarks(tmp_path / "scan.pts", template, tmp_path / "scan.usdc")
    _, points = load_scan_landmarks(tmp_path / "scan.pts", template, tmp_path / "scan.usdc", "cm")
    assert points[0].tolist() == [0, 0, 10]
