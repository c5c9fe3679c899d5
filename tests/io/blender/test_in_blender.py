"""In Blender itself: our files open as they are meant, and Blender's own come back. ``make test-blender``."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from rig_samples import corrective_sheet, named_sheet
from scipy.spatial import cKDTree

from torchface import BlendshapeRig, Corrective, Correctives, Take, Track, load_rig, save_animation, save_rig
from torchface.cli import main
from torchface.io import load_animation
from torchface.io.blender.blender_files import blender_command
from torchface.synthetic import performer

pytestmark = pytest.mark.blender
SCRIPT = Path(__file__).with_name("shown_in_blender.py")
FPS, FRAMES = 30.0, 4
METRES, MILLIMETRES = 1e-5, 1e-2


def in_blender(*words: str | Path, script: Path = SCRIPT) -> None:
    """Runs a script beside this file."""
    done = subprocess.run([*blender_command(script), *map(str, words)], capture_output=True, text=True, check=False)
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
    """Each vertex with all its deltas, (V,(1+N)*3), millimetres: vertices that only touch are kept apart."""
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
    assert played.weights.names == found.names


def test_an_fbx_that_blender_made_becomes_a_glb(
    actor: BlendshapeRig, take: Take, files: Path, tmp_path: Path, messages_of: Callable[..., str]
) -> None:
    in_blender("export", files / "actor.glb", tmp_path / "made.fbx")
    assert f"{len(actor.names)} shapes" in messages_of("convert", tmp_path / "made.fbx", tmp_path / "actor.glb")
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


@pytest.fixture(scope="module")
def corrected() -> BlendshapeRig:
    """A sheet with products, two in-betweens of one shape, and names that drivers have to escape."""
    rig = corrective_sheet()
    definitions = (*rig.correctives.definitions, Corrective('half of "jaw"', ("jawOpen",), 0.6))
    deltas = torch.cat([rig.correctives.deltas, rig.correctives.deltas[:1].flip(1)])
    return BlendshapeRig(rig.neutral, rig.deltas, rig.names, Correctives(deltas, definitions))


def in_blenders_axes(places: torch.Tensor) -> np.ndarray:
    """Millimetres, y up, (...,V,3) as metres, z up."""
    metres = places.double() / 1000
    return torch.stack([metres[..., 0], -metres[..., 2], metres[..., 1]], -1).numpy()


@pytest.mark.parametrize("ending", [".fbx", ".blend"])
def test_correctives_play_in_blender_and_come_back(
    ending: str, corrected: BlendshapeRig, tmp_path: Path, messages_of: Callable[..., str]
) -> None:
    values = 1.3 * torch.rand(6, 3, 1, generator=torch.Generator().manual_seed(2)) - 0.1
    save_animation(corrected, Take(FPS, weights=Track(corrected.names, values)), tmp_path / "sheet.usdc")
    told = messages_of("convert", tmp_path / "sheet.usdc", tmp_path / f"sheet{ending}")
    assert (".fbx has no correctives: the 4 are shape keys of their own" in told) == (ending == ".fbx")
    in_blender("show", tmp_path / f"sheet{ending}", tmp_path / "shown.npz", FPS)
    shown = np.load(tmp_path / "shown.npz")
    assert shown["names"].tolist() == [*corrected.names, *corrected.correctives.names]
    expected = in_blenders_axes(corrected(values[..., 0]))
    assert np.abs(shown["frames"] - expected).max() < METRES
    main(["convert", str(tmp_path / f"sheet{ending}"), str(tmp_path / "back.usdc")])
    found = load_rig(tmp_path / "back.usdc")
    assert found.names == corrected.names
    assert {one.name: one for one in found.correctives.definitions} == {
        one.name: one for one in corrected.correctives.definitions
    }
    assert (found(values[..., 0]) - corrected(values[..., 0])).abs().max() < MILLIMETRES
    played = load_animation(tmp_path / "back.usdc")
    assert played.weights.names == corrected.names
    assert (played.weights.values - values).abs().max() < 1e-5


def posed_as_in_blender(rig: BlendshapeRig, poses: list[list[float]], folder: Path) -> None:
    save_rig(rig, folder / "sheet.usdc")
    main(["convert", str(folder / "sheet.usdc"), str(folder / "sheet.blend")])
    for pose in poses:
        sliders = [f"{name}={weight}" for name, weight in zip(rig.names, pose, strict=True)]
        in_blender("pose", folder / "sheet.blend", folder / "posed.npz", *sliders)
        expected = in_blenders_axes(rig(torch.tensor([pose]))[0])
        assert np.abs(np.load(folder / "posed.npz")["places"] - expected).max() < METRES


def test_sliders_of_a_blender_file_move_its_correctives(corrected: BlendshapeRig, tmp_path: Path) -> None:
    posed_as_in_blender(corrected, [[0.2, 0.5, 0.9], [0.45, 1.0, 0.3], [0.8, 0.0, 1.0]], tmp_path)


def test_a_corrective_of_eight_shapes_plays_in_blender_and_comes_back(tmp_path: Path) -> None:
    plain = named_sheet(tuple(f'a long name of "shape" {number}, as some tools write them' for number in range(8)))
    deltas = 20 * torch.randn(1, len(plain.vertices), 3, generator=torch.Generator().manual_seed(4))
    definition = Corrective("all eight", plain.names)
    rig = BlendshapeRig(plain.neutral, plain.deltas, plain.names, Correctives(deltas, (definition,)))
    posed_as_in_blender(rig, [[1.0] * 8, [0.9, 0.8, 1.0, 0.7, 0.95, 1.0, 0.85, 0.9], [1.0] * 7 + [0.0]], tmp_path)
    main(["convert", str(tmp_path / "sheet.blend"), str(tmp_path / "back.usdc")])
    assert load_rig(tmp_path / "back.usdc").correctives.definitions == (definition,)


@pytest.fixture(scope="module")
def strange(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("strange")
    in_blender(folder, script=SCRIPT.with_name("stranger_in_blender.py"))
    return folder


@pytest.mark.parametrize(("ending", "shown"), [(".blend", "grouped"), (".usdc", "frames")])
def test_a_strangers_scene_is_what_blender_shows(ending: str, shown: str, strange: Path, tmp_path: Path) -> None:
    main(["convert", str(strange / f"scene{ending}"), str(tmp_path / "scene.usdc")])
    rig, take = load_rig(tmp_path / "scene.usdc"), load_animation(tmp_path / "scene.usdc")
    places = in_blenders_axes(rig(rig.weights_from(take.weights))).transpose(1, 0, 2)
    assert farthest(places, np.load(strange / f"{shown}.npz")["frames"].transpose(1, 0, 2)) < METRES
    assert (rig.neutral.polygons >= 0).sum(1).max() == 17
    if ending == ".blend":
        assert rig.names == ("Lächeln", "笑顔.L", 'a/b:"c"')
        assert set(rig.neutral.annotations.regions) == {"Kopf", "Zähne", "Sphere"}
        assert rig.neutral.texture is not None


@pytest.mark.parametrize("ending", [".glb", ".fbx"])
def test_a_strangers_head_is_what_blender_shows(ending: str, strange: Path, tmp_path: Path) -> None:
    main(["convert", str(strange / f"scene{ending}"), str(tmp_path / "head.usdc"), "--part", "Kopf"])
    rig, take = load_rig(tmp_path / "head.usdc"), load_animation(tmp_path / "head.usdc")
    assert rig.names == ("Lächeln", "笑顔.L", 'a/b:"c"')
    places = in_blenders_axes(rig(rig.weights_from(take.weights))).transpose(1, 0, 2).reshape(507, -1)
    shown = np.load(strange / "frames.npz")["frames"].transpose(1, 0, 2)
    assert cKDTree(shown.reshape(len(shown), -1)).query(places, p=np.inf)[0].max() < METRES


def test_what_blender_cannot_read_is_named(tmp_path: Path, messages_of: Callable[..., str]) -> None:
    (tmp_path / "broken.fbx").write_bytes(b"Kaydara FBX Binary  \x00\x1a\x00" + b"\xff" * 100)
    told = messages_of("convert", tmp_path / "broken.fbx", tmp_path / "out.glb", status=2)
    assert "broken.fbx" in told
    assert "Traceback" not in told
    assert not (tmp_path / "out.glb").exists()
