"""Tests of ``torchface arkit`` from files to files, on planted models of the embedded performer's head."""

import json
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from planted.published_heads import codes, expression_basis, flame_arrays, gnm_arrays, gnm_landmarks, head
from torchface import Mesh, Take, Track, load_mesh, load_rig, load_take, save_mesh, save_rig
from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.io.weights.weight_csv import ROTATIONS, save_weights_csv
from torchface.modeling import HeadModel
from torchface.progress import silent
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT
from torchface.synthetic import performer
from torchface.workflows.arkit import arkit_job, arkit_rig
from torchface.workflows.arkit.arkit_job import AnimationSettings, animation_to_weights, arkit_head, weights_back
from torchface.workflows.arkit.arkit_rig import ArkitRig, Source
from torchface.workflows.named_heads import load_head_model, matching

FRAMES = 30
SHAPES = ["eyeBlinkLeft", "eyeLookInRight", "jawOpen", "mouthPucker", "mouthSmileLeft", "browInnerUp"]
ALONE = AnimationSettings(temporal=False)


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return head()


@pytest.fixture(scope="module")
def weights(rig: BlendshapeRig) -> torch.Tensor:
    generator = torch.Generator().manual_seed(5)
    weights = torch.zeros(FRAMES, len(rig.names))
    weights[:, rig.index(SHAPES)] = torch.rand(FRAMES, len(SHAPES), generator=generator)
    return weights


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, rig: BlendshapeRig, weights: torch.Tensor) -> Path:
    """A planted FLAME and its codes, a rig, and meshes."""
    folder = tmp_path_factory.mktemp("arkit")
    np.savez(folder / "flame.npz", **flame_arrays(rig))
    exp = codes(rig, expression_basis(rig), weights).numpy()
    shape = np.tile(np.array([1.0, -1.0, 0.5]), (FRAMES, 1))  # another person, to whom the codes mean the same
    rest = {"pose": np.zeros((FRAMES, 6)), "cam": np.zeros((FRAMES, 3)), "fps": 60.0}
    np.savez(folder / "take.npz", exp=exp, shape=shape, **rest)
    save_rig(rig, folder / "rig.glb")
    save_rig(rig.select(SHAPES), folder / "template.glb")
    return folder


@pytest.fixture(scope="module", autouse=True)
def shapes_made_once() -> Iterator[None]:
    """A source's shapes take seconds, and several tests ask for those of the same file."""
    make, made = arkit_job.make_arkit, {}

    def once(source: Source, template: Path | None = None, *more: Any, **named: Any) -> ArkitRig:
        key = source.path, template
        if key not in made:
            made[key] = make(source, template, *more, **named)
        return made[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arkit_job, "make_arkit", once)
        yield


def solved(path: Path, rig: BlendshapeRig) -> torch.Tensor:
    take = load_take(path)
    assert [name.lower() for name in take.weights.names] == [name.lower() for name in ARKIT]
    return rig.weights_from(take.weights)


def test_a_head_model_gets_the_shapes_on_its_own_vertices(folder: Path, rig: BlendshapeRig) -> None:
    """The model's mean is the template's head, so that the shapes are the template's own."""
    lines = arkit_head(folder / "flame.npz", folder / "flame.glb", folder / "template.glb", None, False, None, silent)
    made = load_rig(folder / "flame.glb")
    assert "6 of ARKit's 52" in lines[0]
    assert "no tongue" in lines[-1]
    assert made.names == tuple(SHAPES)
    assert torch.equal(made.neutral.faces, rig.neutral.faces)
    for name in SHAPES:
        a, b = (one.deltas[one.index([name])[0]] for one in (made, rig))
        assert float((a - b).norm() / b.norm()) < 0.08, name
    landmarks = made.vertices[made.neutral.landmarks]
    assert float((landmarks - rig.vertices[rig.neutral.landmarks]).norm(dim=1).max()) < 1.0


def test_codes_become_the_planted_weights_and_go_back(
    folder: Path, rig: BlendshapeRig, weights: torch.Tensor, tmp_path: Path
) -> None:
    settings = AnimationSettings(folder / "template.glb", temporal=False)
    lines = animation_to_weights(folder / "flame.npz", folder / "take.npz", tmp_path / "w.csv", settings, silent)
    assert float((solved(tmp_path / "w.csv", rig) - weights).abs().max()) < 0.04
    take = load_take(tmp_path / "w.csv")
    assert take.fps == pytest.approx(60.0)
    assert float(weights[:, rig.index(["eyeLookInRight"])].max()) > 0.5
    for name in ROTATIONS:  # the right eye looks in, to the left: by 30 degrees at weight 1, as it is carried over
        turned = -math.radians(30) if name == "RightEyeYaw" else 0.0
        expected = turned * take.weights.select(["EyeLookInRight"]).values[:, 0, 0].double()
        torch.testing.assert_close(take.extras["columns"][name], expected, atol=1e-3, rtol=0.03)
    assert any("left out of take.npz: cam" in line for line in lines)
    table = np.loadtxt(tmp_path / "w_error.csv", delimiter=",", skiprows=1)
    assert table.shape == (FRAMES, 5)
    assert table[:, 2].max() < 0.11
    lines = weights_back(
        folder / "flame.npz", tmp_path / "w.csv", tmp_path / "back.npz", settings.template, None, silent
    )
    back, truth = np.load(tmp_path / "back.npz"), np.load(folder / "take.npz")
    basis = expression_basis(rig).flatten(1).numpy()
    apart = (back["exp"] - truth["exp"]) @ basis
    assert np.sqrt((apart**2).mean()) < 0.1 * np.sqrt(((truth["exp"] @ basis) ** 2).mean())


def write_point_cache(meshes: torch.Tensor, path: Path) -> None:
    """In centimetres, z up, 20 frames a second, without topology; a second prim of one point moves too."""
    pytest.importorskip("pxr")
    from pxr import Sdf, Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(path))
    stage.SetTimeCodesPerSecond(20)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    turned = meshes @ torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) / 10
    for place, points in (("/World/eye", turned[:, :1]), ("/World/face", turned)):
        attribute = stage.OverridePrim(place).CreateAttribute("points", Sdf.ValueTypeNames.Point3fArray)
        for row, frame in enumerate(points):
            attribute.Set(Vt.Vec3fArray.FromNumpy(frame.numpy()), row)
    stage.Save()


@pytest.mark.parametrize("kind", ["obj", "npy", "anchors", "cache"])
def test_meshes_of_a_rigs_topology_become_the_planted_weights(
    kind: str, folder: Path, rig: BlendshapeRig, weights: torch.Tensor, tmp_path: Path
) -> None:
    """In millimetres, metres, metres with times, and a point cache of USD; the head turned."""
    few = 3
    meshes = rig(weights[:few]) @ torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]) + 20.0
    path = tmp_path / {"obj": "meshes", "npy": "meshes.npy", "anchors": "meshes.json", "cache": "meshes.usd"}[kind]
    if kind == "obj":
        path.mkdir()
        for number, vertices in enumerate(meshes):
            save_mesh(Mesh(vertices, rig.neutral.faces), path / f"{number:03}.obj")
    elif kind == "npy":
        np.save(path, (meshes / 1000).flatten(1).numpy())
    elif kind == "cache":
        write_point_cache(meshes, path)
    else:
        frames = [{"timestamp": 0.05 * i, "vertices": (one / 1000).tolist()} for i, one in enumerate(meshes)]
        path.write_text(json.dumps({"frames": frames}))
    save_mesh(Mesh(rig.vertices, rig.neutral.faces), tmp_path / "neutral.obj")
    mesh = load_mesh(tmp_path / "neutral.obj")
    save_rig(BlendshapeRig(mesh, rig.deltas, rig.names), tmp_path / "plain.glb")
    lines = animation_to_weights(tmp_path / "plain.glb", path, tmp_path / "w.csv", ALONE, silent)
    assert float((solved(tmp_path / "w.csv", rig) - weights[:few]).abs().mean()) < 0.01
    assert any("taken to be in metres" in line for line in lines) is (kind in ("npy", "anchors"))
    assert load_take(tmp_path / "w.csv").fps == pytest.approx(20.0 if kind in ("anchors", "cache") else 30.0, rel=1e-2)


def test_meshes_in_left_handed_axes_are_turned_round_and_said(
    folder: Path, rig: BlendshapeRig, weights: torch.Tensor, tmp_path: Path
) -> None:
    meshes = rig(weights[:1])[0] * torch.tensor([-0.1, 0.1, 0.1])  # one frame, centimetres
    np.savez(tmp_path / "unity.npz", vertices=meshes.numpy())
    lines = animation_to_weights(folder / "rig.glb", tmp_path / "unity.npz", tmp_path / "w.csv", ALONE, silent)
    assert float((solved(tmp_path / "w.csv", rig) - weights[:1]).abs().mean()) < 0.01
    assert lines[0].startswith("unity.npz: mirrored, as by left-handed axes")
    assert "centimetres" in lines[1]


def test_another_animation_is_refused_with_what_is_wrong(folder: Path, rig: BlendshapeRig, tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", blend=np.zeros((3, 5)))
    with pytest.raises(FileFormatError, match=r"other\.npz: found no vertices \(but blend\), expected .* exp"):
        animation_to_weights(folder / "rig.glb", tmp_path / "other.npz", tmp_path / "w.csv", ALONE, silent)
    save_mesh(Mesh(rig.vertices, rig.neutral.faces.flip(0)), tmp_path / "frame.obj")
    with pytest.raises(FileFormatError, match=r"triangle 0 of vertices .* another order"):
        animation_to_weights(folder / "rig.glb", tmp_path / "frame.obj", tmp_path / "w.csv", ALONE, silent)
    (tmp_path / "my hero.fbx").touch()
    with pytest.raises(FileFormatError, match=r"torchface convert '.*my hero\.fbx' '.*my hero\.glb' reads it with"):
        arkit_head(tmp_path / "my hero.fbx", tmp_path / "a.glb", None, None, False, None, silent)


def test_frames_that_are_no_faces_of_the_head_are_named(
    folder: Path, rig: BlendshapeRig, weights: torch.Tensor, tmp_path: Path
) -> None:
    source, out, meshes = folder / "rig.glb", tmp_path / "w.csv", rig(weights[:4])

    def solved_lines(frames: torch.Tensor) -> list[str]:
        np.save(tmp_path / "m.npy", frames.numpy())
        return animation_to_weights(source, tmp_path / "m.npy", out, ALONE, silent)

    with pytest.raises(ValueRangeError, match=r"4 of 4 frames lie more than 10 mm .* order of vertices"):
        solved_lines(meshes.roll(1, 1))
    nan = meshes.clone()
    nan[2, 7, 1] = torch.nan
    with pytest.raises(FileFormatError, match=r"in 1 of 4 rows, first at \[2, 7, 1\]"):
        solved_lines(nan)
    assert not out.exists()
    meshes[3] *= 10
    lines = solved_lines(meshes)
    assert "1 of 4 frames lie more than 10 mm" in lines[0]
    assert "frame 3 by" in lines[0]
    assert not any("warning" in line for line in solved_lines(rig(weights[:4])))


def test_missing_frames_are_counted_and_times_that_fall_refused(
    folder: Path, rig: BlendshapeRig, weights: torch.Tensor, tmp_path: Path
) -> None:
    out, meshes = tmp_path / "w.csv", rig(weights[:5])
    (tmp_path / "meshes").mkdir()
    mesh = load_rig(folder / "rig.glb").neutral
    for number in (8, 9, 10, 12):  # by number, not by letter
        save_mesh(mesh.with_vertices(meshes[number - 8]), tmp_path / "meshes" / f"f{number}.glb")
    lines = animation_to_weights(folder / "rig.glb", tmp_path / "meshes", out, ALONE, silent)
    assert "1 of 5 frames are missing, first from f10.glb to f12.glb" in lines[0]
    assert float((solved(out, rig) - weights[[0, 1, 2, 4]]).abs().mean()) < 0.01

    def anchors(*times: object) -> list[str]:
        frames = [{"timestamp": t, "vertices": (one / 1000).tolist()} for t, one in zip(times, meshes, strict=False)]
        (tmp_path / "a.json").write_text(json.dumps(frames))
        return animation_to_weights(folder / "rig.glb", tmp_path / "a.json", out, ALONE, silent)

    assert "2 of 5 frames are missing" in anchors(0.0, 0.02, 0.08)[0]
    assert load_take(out).fps == pytest.approx(50)
    with pytest.raises(FileFormatError, match=r"\[2\].timestamp = 0.01, expected more than the 0.02 s"):
        anchors(0.0, 0.02, 0.01)
    with pytest.raises(FileFormatError, match="expected seconds"):
        anchors("a", 0.02)
    (tmp_path / "a.json").write_text(json.dumps([{"vertices": [[0, 0, 0]] * 1220}]))
    with pytest.raises(FileFormatError, match=f"vertices of 1220, expected the head's {len(rig.vertices)} vertices"):
        animation_to_weights(folder / "rig.glb", tmp_path / "a.json", out, ALONE, silent)


def test_the_rate_is_the_files_and_another_is_said(
    folder: Path, rig: BlendshapeRig, weights: torch.Tensor, tmp_path: Path
) -> None:
    out, meshes = tmp_path / "w.csv", rig(weights[:4]).numpy()
    np.savez(tmp_path / "stated.npz", vertices=meshes, fps=25)
    np.savez(tmp_path / "unstated.npz", vertices=meshes)

    def lines_of(name: str, fps: float | None) -> str:
        settings = AnimationSettings(temporal=False, fps=fps)
        return "\n".join(animation_to_weights(folder / "rig.glb", tmp_path / name, out, settings, silent))

    for name, fps, taken, said in (
        ("stated.npz", None, 25, ""),
        ("stated.npz", 25.0, 25, ""),
        ("stated.npz", 50.0, 50, "warning: stated.npz has 25 frames a second; 50 are taken (--fps)"),
        ("unstated.npz", None, 30, "unstated.npz has no frame rate; 30 a second are assumed (--fps)"),
        ("unstated.npz", 24.0, 24, ""),
    ):
        lines = lines_of(name, fps)
        assert load_take(out).fps == pytest.approx(taken)
        assert f"4 frames at {taken} a second" in lines
        assert said in lines
        assert ("(--fps)" in lines) is bool(said)
    for wrong in (np.zeros(0), -1.0):
        np.savez(tmp_path / "wrong.npz", vertices=meshes, fps=wrong)
        with pytest.raises(FileFormatError, match=r"found fps of|frames a second, expected"):
            lines_of("wrong.npz", None)
    save_weights_csv(Take(24.0, weights=Track(["jawOpen"], torch.zeros(3, 1, 1))), tmp_path / "named.csv")
    with pytest.raises(ValueRangeError, match=r"--fps: found 60, expected none beside weights, .* 24 a second"):
        lines_of("named.csv", 60.0)


@pytest.mark.parametrize("kind", ["mediapipe", "audio2face", "anchors"])
def test_the_rate_of_weights_without_times_is_set(folder: Path, tmp_path: Path, kind: str) -> None:
    category = {"category_name": "jawOpen", "score": 0.5}
    documents = {
        "mediapipe": [{"face_blendshapes": [[category]]}] * 3,
        "audio2face": {"facsNames": ["jawOpen"], "weightMat": [[0.5]] * 3},
        "anchors": [{"blendShapes": {"jawOpen": 0.5}}] * 3,
    }
    source, out = tmp_path / "named.json", tmp_path / "w.csv"
    source.write_text(json.dumps(documents[kind]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (line,) = animation_to_weights(folder / "rig.glb", source, out, AnimationSettings(fps=25.0), silent)
    assert "3 frames of weights by name, 25 a second" in line
    assert load_take(out).fps == pytest.approx(25.0)
    timed = {
        "mediapipe": [{"timestamp_ms": 20 * i, "face_blendshapes": [[category]]} for i in range(3)],
        "audio2face": {"exportFps": 50, "facsNames": ["jawOpen"], "weightMat": [[0.5]] * 3},
        "anchors": [{"timestamp": i / 50, "blendShapes": {"jawOpen": 0.5}} for i in range(3)],
    }
    source.write_text(json.dumps(timed[kind]))
    with pytest.raises(ValueRangeError, match=r"--fps: found 25, expected none beside weights, .* 50 a second"):
        animation_to_weights(folder / "rig.glb", source, out, AnimationSettings(fps=25.0), silent)


def test_shapes_that_a_rig_has_are_kept_and_only_the_others_made(rig: BlendshapeRig, tmp_path: Path) -> None:
    few = rig.select(["eyeBlinkLeft", "jawOpen", "mouthPucker"])
    save_rig(rig.select(SHAPES), tmp_path / "template.glb")
    doubled = BlendshapeRig(few.neutral, 2 * few.deltas, ["Fcl_EYE_Close_L", "A25_Jaw_Open", "Ears_Wiggle"])
    save_rig(doubled, tmp_path / "few.glb")
    lines = arkit_head(tmp_path / "few.glb", tmp_path / "all.glb", tmp_path / "template.glb", None, False, None, silent)
    made = load_rig(tmp_path / "all.glb")
    assert "4 made, 2 of its own kept" in lines[0]
    assert made.names[-1] == "Ears_Wiggle"
    kept = made.deltas[made.index(["jawOpen"])[0]]
    assert torch.allclose(kept, 2 * few.deltas[1], atol=1e-3)


def test_audio2faces_weights_go_by_name(tmp_path: Path) -> None:
    document = {
        "exportFps": 25.0,
        "facsNames": ["jawOpen", "eyeLookUpLeft", "tongueTipUp"],
        "weightMat": [[0.5, 0.4, 0.2]],
    }
    (tmp_path / "a2f.json").write_text(json.dumps(document))
    lines = animation_to_weights(tmp_path / "none.glb", tmp_path / "a2f.json", tmp_path / "w.csv", ALONE, silent)
    take = load_take(tmp_path / "w.csv")
    assert float(take.weights.select(["JawOpen"]).values[0]) == pytest.approx(0.5)
    assert "ARKit has no tongueTipUp" in lines[0]
    assert float(take.extras["columns"]["LeftEyePitch"]) == pytest.approx(-0.4 * math.radians(26), abs=0.002)
    assert float(take.extras["columns"]["RightEyePitch"]) == 0


@pytest.mark.bench
def test_a_published_model_is_a_head_model_with_its_rig(
    tmp_path: Path, rig: BlendshapeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.savez(tmp_path / "gnm_head.npz", **gnm_arrays(rig))
    gnm_landmarks(rig, tmp_path / "head_sparse_68.txt")
    few = performer(texture=False).select(SHAPES)
    monkeypatch.setattr(arkit_rig, "performer", lambda texture: few)
    model = load_head_model(tmp_path / "gnm_head.npz")
    assert isinstance(model, HeadModel)
    same, shapes = matching(model)
    assert same is model
    assert shapes.names == tuple(SHAPES)
    assert len(model.landmarks) == 68


def test_what_is_of_another_model_is_named(folder: Path, rig: BlendshapeRig, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="expected their head model as SOURCE"):
        animation_to_weights(folder / "rig.glb", folder / "take.npz", tmp_path / "w.csv", ALONE, silent)
    np.savez(tmp_path / "wide.npz", exp=np.zeros((3, 300)))
    with pytest.raises(FileFormatError, match="at most 51 parameters"):
        animation_to_weights(folder / "flame.npz", tmp_path / "wide.npz", tmp_path / "w.csv", ALONE, silent)
    np.savez(tmp_path / "jaw.npz", exp=np.zeros((3, 20)), jaw=np.zeros((2, 3)))
    with pytest.raises(FileFormatError, match="jaw of f"):
        animation_to_weights(folder / "flame.npz", tmp_path / "jaw.npz", tmp_path / "w.csv", ALONE, silent)
    np.savez(tmp_path / "other.npz", vertices=np.zeros((3, 100, 3)))
    with pytest.raises(FileFormatError, match="vertices of f"):
        animation_to_weights(folder / "rig.glb", tmp_path / "other.npz", tmp_path / "w.csv", ALONE, silent)
    (tmp_path / "strange.csv").write_text("frame,time,wiggle\n0,0,1\n")
    with pytest.raises(NameMismatchError, match="expected some of ARKit's names"):
        animation_to_weights(folder / "rig.glb", tmp_path / "strange.csv", tmp_path / "w.csv", ALONE, silent)
    with pytest.raises(FileFormatError, match="no expression parameters"):
        weights_back(folder / "rig.glb", folder / "take.npz", tmp_path / "back.npz", None, None, silent)
    assert not (tmp_path / "w.csv").exists()
