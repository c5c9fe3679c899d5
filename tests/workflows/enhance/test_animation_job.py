"""A folder of animations is enhanced as each alone, whatever else lies in it."""

import csv
from pathlib import Path

import pytest

from tests.workflows.enhance.conftest import FPS, Actor
from torchface.cli import main
from torchface.io import MeshSequence, save_animation
from torchface.take import Take, Track


@pytest.fixture
def takes(actor: Actor, tmp_path: Path) -> Path:
    """Weights, an animated rig, and weights of other shapes; a video beside them."""
    folder = tmp_path / "takes"
    folder.mkdir()
    (folder / "calm.csv").write_bytes((actor.folder / "weights.csv").read_bytes())
    take = Take(FPS, weights=Track(actor.rig.names, actor.weights[::3, :, None]))
    save_animation(actor.rig, take, folder / "loud.glb")
    (folder / "other.csv").write_text("frame,time,tailWag\n0,0,0\n1,0.1,1\n")
    (folder / "film.mp4").write_text("x")
    return folder


def enhance(actor: Actor, given: Path, out: Path, *more: str) -> None:
    words = [given, "--model", actor.model, "--rig", actor.folder / "rig.glb", "--out", out, "--height", "60", *more]
    main(["enhance", "--no-video", "--no-glb", *map(str, words)])


def test_a_folder_of_animations_is_enhanced_as_each_alone(
    actor: Actor, takes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        enhance(actor, takes, tmp_path / "many")
    assert ended.value.code == 1
    told = " ".join(capsys.readouterr().err.split())
    assert "2 of 3 animations enhanced" in told
    assert "left out 1 video" in told
    with (tmp_path / "many" / "summary.csv").open() as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert [rows[name]["status"] for name in ("calm", "loud", "other")] == ["done", "done", "skipped"]
    assert rows["calm"]["frames"] == "12"
    assert "tailWag" in rows["other"]["remarks"]
    assert not (tmp_path / "many" / "other").exists()
    enhance(actor, takes / "loud.glb", tmp_path / "alone", "--quiet")
    one, many = (tmp_path / name / "enhanced.safetensors" for name in ("alone", "many/loud"))
    assert len(MeshSequence(one)) == 4
    assert one.read_bytes() == many.read_bytes()
