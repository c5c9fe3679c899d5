"""In Blender itself: our files open as they are meant, and Blender's own come back. ``make test-blender``."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from torchface.cli import main
from torchface.io import load_animation, load_rig, save_animation
from torchface.io.blender import blender_command, blender_process
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer
from torchface.take import Take, Track

pytestmark = pytest.mark.blender
SCRIPT = Path(__file__).with_name("shown_in_blender.py")
FPS, FRAMES = 30.0, 4
METRES, MILLIMETRES = 1e-5, 1e-2


def in_blender(*words: str | Path) -> None:
    """Runs the script beside this file."""
    product = str(Path(blender_process.__file__).resolve())
    command = [str(SCRIPT) if word == product else word for word in blender_command()]
    done = subprocess.run([*command, *map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.fixture(scope="module")
def actor() -> BlendshapeRig:
    """The performer, textured, eyes on nodes of their own, and a shape under a name that USD's prims cannot have."""
    whole = performer()
    rig = whole.select(("jawOpen", "eyeBlinkLeft", "mouthSmileRight", "eyeLookUpLeft"))
    return BlendshapeRig(rig.neutral, rig.deltas, ("jawOpen", "eyeBlinkLeft", "mouth smile.R", "eyeLookUpLeft"))


@pytest.fixture(scope="module")
def take(actor: BlendshapeRig) -> Take:
    values = torch.rand(FRAMES, len(actor.names), 1, generator=torch.Generator().manual_seed(0))
    return Take(FPS, weights=Track(actor.names, values))


@pytest.fixture(scope="module")
def files(actor: BlendshapeRig, take: Take, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("in_blender")
    save_animation(actor, take, folder / "actor.glb")
    save_animation(actor, take, folder / "actor.usdc")
    return folder


def farthest(found: np.ndarray, expected: np.ndarray) -> float:
    """The largest distance, of any coordinate, from a row of either (V,...) to the nearest of the other."""
    found, expected = (one.reshape(len(one), -1) for one in (found, expected))
    return max(
        cKDTree(found).query(expected, p=np.inf)[0].max(),
        cKDTree(expected).query(found, p=np.inf)[0].max(),
    )


def motion(rig: BlendshapeRig) -> np.ndarray:
    """Each vertex with all its deltas, (V,(1+N)*3), millimetres: vertices that only touch are told apart."""
    return torch.cat([rig.vertices[None], rig.deltas]).permute(1, 0, 2).double().numpy()


@pytest.mark.parametrize("ending", [".glb", ".usdc"])
def test_our_files_open_and_play_in_blender(
    ending: str, actor: BlendshapeRig, take: Take, files: Path, tmp_path: Path
) -> None:
    in_blender("show", files / f"actor{ending}", tmp_path / "shown.npz", FPS)
    shown = np.load(tmp_path / "shown.npz")
    assert shown["names"].tolist() == list(actor.names)
    assert len(shown["images"]) >= 1
    assert shown["frames"].shape[0] == FRAMES
    places = torch.cat([actor.vertices[None], actor(actor.weights_from(take.weights))]).double() / 1000
    upright = torch.stack([places[..., 0], -places[..., 2], places[..., 1]], -1).permute(1, 0, 2).numpy()
    there = np.concatenate([shown["rest"][None], shown["frames"]]).transpose(1, 0, 2)
    assert farthest(there, upright) < METRES


@pytest.mark.parametrize("source", [".glb", ".usdc"])
@pytest.mark.parametrize("ending", [".glb", ".usdc"])
def test_blenders_own_export_comes_back(
    source: str, ending: str, actor: BlendshapeRig, files: Path, tmp_path: Path
) -> None:
    in_blender("export", files / f"actor{source}", tmp_path / f"back{ending}")
    found = load_rig(tmp_path / f"back{ending}")
    plain = [name.replace(" ", "_").replace(".", "_") for name in actor.names]  # as Blender writes them into USD
    assert list(found.names) in (list(actor.names), plain)
    assert farthest(motion(found), motion(actor)) < MILLIMETRES
    played = load_animation(tmp_path / f"back{ending}")
    assert played is not None
    assert played.weights is not None
    assert played.weights.names == found.names


def test_an_fbx_that_blender_made_becomes_a_glb(
    actor: BlendshapeRig, take: Take, files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    in_blender("export", files / "actor.glb", tmp_path / "made.fbx")
    main(["convert", str(tmp_path / "made.fbx"), str(tmp_path / "actor.glb")])
    assert f"{len(actor.names)} shapes" in capsys.readouterr().err
    found = load_rig(tmp_path / "actor.glb")
    assert found.names == actor.names
    assert farthest(motion(found), motion(actor)) < MILLIMETRES
    assert found.neutral.texture is not None


@pytest.mark.parametrize("ending", [".fbx", ".blend"])
def test_a_rig_goes_through_blenders_files_vertex_by_vertex(
    ending: str, actor: BlendshapeRig, take: Take, files: Path, tmp_path: Path
) -> None:
    main(["convert", str(files / "actor.usdc"), str(tmp_path / f"actor{ending}")])
    main(["convert", str(tmp_path / f"actor{ending}"), str(tmp_path / "back.usdc")])
    found = load_rig(tmp_path / "back.usdc")
    assert found.names == actor.names
    assert (found.vertices - actor.vertices).abs().max() < MILLIMETRES
    assert (found.deltas - actor.deltas).abs().max() < MILLIMETRES
    assert torch.equal(found.neutral.polygons, actor.neutral.polygons)
    corners, expected = found.neutral.uvs[found.neutral.uv_faces], actor.neutral.uvs[actor.neutral.uv_faces]
    assert (corners - expected).abs().max() < 1e-5
    assert found.neutral.texture.shape == actor.neutral.texture.shape
    played = load_animation(tmp_path / "back.usdc")
    assert played.fps == FPS
    assert (actor.weights_from(played.weights) - actor.weights_from(take.weights)).abs().max() < 1e-5


def test_what_blender_cannot_read_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "broken.fbx").write_bytes(b"Kaydara FBX Binary  \x00\x1a\x00" + b"\xff" * 100)
    with pytest.raises(SystemExit) as ended:
        main(["convert", str(tmp_path / "broken.fbx"), str(tmp_path / "out.glb")])
    assert ended.value.code == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "broken.fbx" in told
    assert "Traceback" not in told
    assert not (tmp_path / "out.glb").exists()
