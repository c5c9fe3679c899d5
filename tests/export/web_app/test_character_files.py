"""The page's own modules under Node: characters, and takes saved as files."""

import base64
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import posted
from edited_characters import edited, sheet
from osc_receiver import values_by_address
from rig_samples import corrective_sheet, quad_sheet
from scipy.spatial.transform import Rotation
from test_vrm_in_browser import browser as vrm_browser  # noqa: F401  (three-vrm's packages)

from planted.characters import Planted, write_character
from planted.glb_files import packed, unpacked
from torchface import load_rig, load_take, save_rig
from torchface.io.gltf.accessors import read_floats
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.gltf.gltf_document import read_document
from torchface.io.gltf.performance_animation import Performance, performed_glb
from torchface.io.gltf.primitive_reading import read_target_names
from torchface.io.protocols.vmc_packets import VmcPackets
from torchface.io.weights.weight_csv import save_weights_csv
from torchface.shape_names import ARKIT, VRM1, mapping
from torchface.workflows.browser_app.character import load_character
from torchface.workflows.head_rotations import head_angles

pytestmark = pytest.mark.browser
VRM_WEB = Path(__file__).parents[2] / "io" / "vrm" / "web"
Run = Callable[[str, object], Any]


def test_a_character_takes_weights_by_name_and_turns_as_the_head_does(run: Run, tmp_path: Path) -> None:
    names = ("jawOpen", "mouthSmile_L", "browInnerUp_R", "antenna", "EyeBlinkLeft")
    told = run("pose", sheet(tmp_path / "sheet.glb", names))
    expected = mapping(ARKIT, names) @ (torch.arange(52) + 1.0) / 100
    np.testing.assert_allclose([told["influences"][name] for name in names], expected, atol=1e-6)
    np.testing.assert_allclose(told["ways"]["face"], [np.sin(0.3), 0, np.cos(0.3)], atol=1e-6)
    vertices = quad_sheet().vertices / 1000
    np.testing.assert_allclose(told["box"], [vertices.amin(0), vertices.amax(0)], atol=1e-5)


def test_morph_targets_summed_for_software_drawing_are_those_of_three(run: Run, tmp_path: Path) -> None:
    """On a file whose one mesh two nodes share."""
    data = sheet(tmp_path / "sheet.glb", ("jawOpen", "mouthClose", "antenna", "browInnerUp")).read_bytes()

    def shared(root: dict[str, Any]) -> None:
        root["nodes"].append({"mesh": root["nodes"][0]["mesh"], "translation": [1.0, 0.0, 0.0]})
        root["scenes"][0]["nodes"].append(len(root["nodes"]) - 1)

    told = run("morphing", edited(data, tmp_path / "shared.glb", shared))
    expected, found = np.array(told["expected"]), np.array(told["found"])
    assert expected.shape[0] == 2
    assert np.abs(expected[0] - expected[1]).max() > 0.05 * np.abs(expected).max()  # each its own pose
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
    assert not told["left"]


def test_matte_surfaces_are_drawn_without_fine_normals_but_with_wrinkles_in_software(run: Run) -> None:
    matte, shiny = "MeshLambertMaterial", "MeshStandardMaterial"
    assert run("lighter", None) == [[matte, False, ""], [matte, True, ""], [shiny, True, "srgb"], [matte, False, ""]]


def saved(run: Run, job: dict[str, Any], kind: str) -> bytes:
    return base64.b64decode(run("save", {**job, "kind": kind}))


TILT = [0.0, 0.0, 0.3826834, 0.9238795]  # 45 degrees about z: bones rarely lie along the axes


def with_bones(root: dict[str, Any]) -> None:
    """Neck, head and eyes beside the mesh, as bones of a skin that nothing is bound to."""
    first = len(root["nodes"])
    root["nodes"] += [
        {"name": "mixamorig:Neck", "rotation": TILT, "translation": [0.0, 0.1, 0.0], "children": [first + 1]},
        {"name": "mixamorig:Head", "rotation": TILT, "children": [first + 2, first + 3]},
        {"name": "LeftEye", "rotation": TILT, "translation": [0.03, 0.05, 0.1]},
        {"name": "RightEye", "translation": [-0.03, 0.05, 0.1]},
    ]
    root["skins"] = [{"joints": [first, first + 1]}]
    root["scenes"][0]["nodes"].append(first)


def of_vrm_0(root: dict[str, Any]) -> None:
    """The same by VRM 0's table, whose characters look along -z; names say nothing."""
    first = len(root["nodes"])
    with_bones(root)
    for number, node in enumerate(root["nodes"][first:]):
        node["name"] = f"bone {number}"
    parts = ("neck", "head", "leftEye", "rightEye")
    bones = [{"bone": part, "node": first + number} for number, part in enumerate(parts)]
    root["extensions"] = {"VRM": {"humanoid": {"humanBones": bones}}}


def plain(root: dict[str, Any]) -> None:
    """Nothing changed: the head has no bone."""


@pytest.mark.parametrize("edit", [with_bones, of_vrm_0, plain])
def test_a_take_in_the_characters_file_is_the_same_from_page_and_python(
    run: Run, tmp_path: Path, edit: Callable[[dict[str, Any]], None]
) -> None:
    path = sheet(tmp_path / "sheet.glb", ("jawOpen", "mouthSmile_L", "antenna"))
    if edit is plain:
        save_rig(corrective_sheet(), path)
    path = edited(path.read_bytes(), tmp_path / "bones.glb", edit)
    rng = np.random.default_rng(3)
    angles = 0.4 * rng.normal(size=(5, 9))
    angles[:, [5, 8]] = 0  # eyes do not roll
    arkit = rng.random((5, 52)).astype(np.float32)
    head = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("YXZ", angles[:, :3]).as_matrix()
    seconds = np.arange(5) / 30
    rows = np.column_stack([seconds, arkit, head.reshape(5, 9), -angles[:, [6, 7, 3, 4]]])
    character = load_character(path)
    job = {"glb": str(path), "rows": rows.tolist(), "sources": json.loads(character.page_table())["sources"]}
    (tmp_path / "page.glb").write_bytes(saved(run, job, ".glb"))
    weights = character.weights(torch.from_numpy(arkit)).numpy()
    all_names, targets = character.targets(torch.from_numpy(weights))
    ours = performed_glb(character.document, Performance(seconds, all_names, targets.numpy(), angles))
    (tmp_path / "python.glb").write_bytes(ours)
    found, expected = (animated(tmp_path / name) for name in ("python.glb", "page.glb"))
    assert found.keys() == expected.keys()
    for name, keys in expected.items():
        if name[1] == "rotation":  # a quaternion and its negative are one rotation
            keys, found[name] = (rows.reshape(-1, 4) for rows in (keys, found[name]))
            keys = keys * np.sign((keys * found[name]).sum(1, keepdims=True))
        np.testing.assert_allclose(found[name], keys, rtol=0, atol=2e-5, err_msg=str(name))
    order = read_target_names(read_document(tmp_path / "python.glb"), 0)
    expected_weights = targets.numpy()[:, [all_names.index(name) for name in order]]
    np.testing.assert_allclose(found["face", "weights"], expected_weights.reshape(-1), atol=1e-6)
    whole = Rotation.from_euler("YXZ", angles[:, :3])
    if edit is plain:
        rig = load_rig(path)
        followed = rig.activation(torch.from_numpy(weights)).numpy()
        assert followed.max() > 0.1
        np.testing.assert_allclose(targets[:, len(character.names) :], followed, atol=1e-6)
        turned = Rotation.from_quat(found["head", "rotation"].reshape(-1, 4))
        assert (turned * whole.inv()).magnitude().max() < 1e-5
        return
    if edit is of_vrm_0:
        neck, own = (Rotation.from_quat(found[f"bone {i}", "rotation"].reshape(-1, 4)) for i in range(2))
        tilt, back = Rotation.from_quat(TILT), Rotation.from_euler("Y", np.pi)
        world = back * neck * own * (back * tilt * tilt).inv()
        assert (world * whole.inv()).magnitude().max() < 1e-5
        return
    neck, own, left = (
        Rotation.from_quat(found[name, "rotation"].reshape(-1, 4))
        for name in ("mixamorig:Neck", "mixamorig:Head", "LeftEye")
    )
    tilt = Rotation.from_quat(TILT)
    assert (neck * own * (tilt * tilt).inv() * whole.inv()).magnitude().max() < 1e-5  # the head in the world
    assert (neck * tilt.inv()).magnitude() == pytest.approx(0.3 * whole.magnitude(), abs=1e-5)
    way = (tilt * tilt * left * (tilt * tilt * tilt).inv()).apply([0.0, 0.0, 1.0])  # beside a head at rest
    np.testing.assert_allclose(np.arctan2(way[:, 0], way[:, 2]), -angles[:, 3], atol=1e-5)
    np.testing.assert_allclose(np.arcsin(way[:, 1]), -angles[:, 4], atol=1e-5)


def planted_rows(count: int = 5) -> np.ndarray:
    """Rows of a take: seconds, weights, rotation, gaze."""
    rng = np.random.default_rng(3)
    head = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("YXZ", 0.3 * rng.normal(size=(count, 3))).as_matrix()
    parts = (np.arange(count) / 30, rng.random((count, 52)), head.reshape(count, 9), 0.2 * rng.normal(size=(count, 4)))
    return np.column_stack(parts)


def test_a_csv_of_the_app_has_short_rows_where_it_saw_no_face(run: Run, tmp_path: Path) -> None:
    """And spreadsheets end rows in cells that have no name."""
    clock = "00:00:00:0"
    path = tmp_path / "take.csv"
    path.write_text(f"Timecode,BlendshapeCount,JawOpen,,\n{clock}1,61,0.5\n{clock}2,0\n{clock}3,61,0.25,,\n")
    rows = np.reshape(run("csv", path), (3, 66))
    assert rows[:, 1 + ARKIT.index("jawOpen")].tolist() == [0.5, 0.0, 0.25]


def test_a_take_comes_back_from_its_csv(run: Run, tmp_path: Path) -> None:
    rows, character = planted_rows(40), sheet(tmp_path / "sheet.glb", ("jawOpen",))
    (tmp_path / "take.csv").write_bytes(saved(run, {"glb": str(character), "rows": rows.tolist()}, ".csv"))
    np.testing.assert_allclose(np.reshape(run("csv", tmp_path / "take.csv"), rows.shape), rows, rtol=0, atol=2e-6)
    take = load_take(tmp_path / "take.csv")
    save_weights_csv(take, tmp_path / "weights.csv")
    again = np.reshape(run("csv", tmp_path / "weights.csv"), rows.shape)
    np.testing.assert_allclose(again[:, :53], rows[:, :53], rtol=0, atol=2e-6)
    start = "frame,time,jawOpen,HeadYaw\n0,0,0.1,0\n"
    broken = tuple(start + row for row in ("1,0.1,0.2\n", "1,x,0.2,0\n", "1,0.1,nan,0\n", "1,0.1,0.2,0x\n"))
    for text in ("", "a,b\n1,2\n", "frame,time,antenna\n0,0,1\n", "Timecode,jawOpen\n", *broken):
        (tmp_path / "other.csv").write_text(text)
        assert isinstance(run("csv", tmp_path / "other.csv"), str), text


@pytest.mark.parametrize(("fps", "count"), [(30, 12), (60, 20), (25, 1), (13, 8), (13, 60)])
def test_all_files_of_a_take_have_its_times_and_its_rate(run: Run, tmp_path: Path, fps: int, count: int) -> None:
    """Also of one under a second, and of one whose frames come unevenly, as a slow camera's do."""
    rows, character = planted_rows(count), sheet(tmp_path / "sheet.glb", ("jawOpen",))
    uneven = np.random.default_rng(1).uniform(-0.2, 0.2, count) if fps == 13 else np.zeros(count)
    rows[:, 0] = (np.arange(count) + uneven - uneven[0]) / fps
    job = {"glb": str(character), "rows": rows.tolist()}
    for kind in (".csv", ".glb", ".usdz"):
        (tmp_path / f"take{kind}").write_bytes(saved(run, job, kind))
    again = np.reshape(run("csv", tmp_path / "take.csv"), rows.shape)
    table, animated = load_take(tmp_path / "take.csv"), read_gltf_weights(tmp_path / "take.glb")
    for seconds in (again[:, 0], table.times, animated.times):
        np.testing.assert_allclose(seconds, rows[:, 0], rtol=0, atol=2e-5)
    from pxr import Usd

    stage = Usd.Stage.Open(str(tmp_path / "take.usdz"))
    if count > 1:
        rate = (count - 1) / rows[-1, 0]
        assert [table.fps, stage.GetTimeCodesPerSecond()] == pytest.approx([rate] * 2, rel=0.01)
        assert stage.GetEndTimeCode() / stage.GetTimeCodesPerSecond() == pytest.approx(rows[-1, 0], rel=1e-5)


def test_a_part_of_a_take_begins_at_0(run: Run) -> None:
    np.testing.assert_allclose(run("part", [0.95, 1.25]), [0, 0.1, 0.2], atol=1e-6)


def without_pictures(root: dict[str, Any]) -> None:
    """Node reads none."""
    for name in ("images", "textures"):
        root.pop(name, None)
    for material in root["materials"]:
        material.get("pbrMetallicRoughness", {}).pop("baseColorTexture", None)


@pytest.mark.parametrize("kind", ["skinned", "bones", "plain"])
def test_openusd_moves_a_saved_character_as_three_does(run: Run, tmp_path: Path, kind: str) -> None:
    from pxr import Gf, Usd, UsdGeom, UsdSkel

    path, names = tmp_path / "character.glb", ("jawOpen", "mouthSmile_L", "antenna")
    if kind == "skinned":
        mesh = quad_sheet()
        deltas = torch.randn(len(names), len(mesh.vertices), 3, generator=torch.Generator().manual_seed(0))
        write_character(path, mesh, dict(zip(names, deltas, strict=True)), Planted(vrm="VRM"))
        edited(path.read_bytes(), path, without_pictures)
    else:
        sheet(path, names)
    if kind == "bones":
        edited(path.read_bytes(), path, with_bones)
    job = {"glb": str(path), "rows": planted_rows().tolist()}
    (tmp_path / "take.usdz").write_bytes(saved(run, job, ".usdz"))
    stage = Usd.Stage.Open(str(tmp_path / "take.usdz"))
    root = UsdSkel.Root(stage.GetPrimAtPath("/Character"))
    animation = UsdSkel.Animation(stage.GetPrimAtPath("/Character/Animation"))
    assert list(animation.GetBlendShapesAttr().Get()) == ["jawOpen", "mouthSmile_L"]
    assert UsdSkel.BakeSkinning(root, Gf.Interval.GetFullInterval())
    meshes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    expected = run("places", job)
    times = animation.GetRotationsAttr().GetTimeSamples() or animation.GetBlendShapeWeightsAttr().GetTimeSamples()
    assert len(times) == len(expected)
    for time, frame in zip(times, expected, strict=True):
        assert len(meshes) == len(frame)
        for prim, places in zip(meshes, frame, strict=True):
            points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(time))
            world = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time))
            np.testing.assert_allclose(points @ world[:3, :3] + world[3, :3], places, rtol=0, atol=2e-5)
    assert np.ptp(np.array(expected[0][0]) - np.array(expected[-1][0]), axis=0).max() > 1e-3


@pytest.mark.parametrize("own", ["", "JawOpen", "TongueOut", "MouthPucker"])
def test_three_vrm_plays_a_saved_vrm_animation(run: Run, tmp_path: Path, vrm_browser: Any, own: str) -> None:  # noqa: F811
    """VRM's expressions on any avatar, ARKit's on one that has a jaw among them; head, neck and gaze."""
    avatar, mesh = tmp_path / "avatar.vrm", quad_sheet()
    names = ("jawOpen", "smile")
    deltas = torch.randn(2, len(mesh.vertices), 3, generator=torch.Generator().manual_seed(0))
    expressions = {"happy": "smile", "aa": "jawOpen"}
    write_character(
        avatar, mesh, dict(zip(names, deltas, strict=True)), Planted(vrm="VRMC_vrm", expressions=expressions)
    )

    def with_own(root: dict[str, Any]) -> None:
        without_pictures(root)
        bind = {"morphTargetBinds": [{"node": 0, "index": 0, "weight": 1.0}]}
        root["extensions"]["VRMC_vrm"]["expressions"]["custom"] = {own: bind} if own else {}

    edited(avatar.read_bytes(), avatar, with_own)
    rows = np.repeat(planted_rows(1), 2, axis=0)
    rows[1, 0] = 1.0  # one pose for a second
    rows[:, 62:] = [0.2, 0.1, 0.2, 0.1]
    (tmp_path / "take.vrma").write_bytes(saved(run, {"glb": str(avatar), "rows": rows.tolist()}, ".vrma"))
    import pygltflib

    assert pygltflib.GLTF2.load_binary(str(tmp_path / "take.vrma")).animations[0].name == "performance"
    files = {"/avatar.vrm": avatar.read_bytes(), "/animation.vrma": (tmp_path / "take.vrma").read_bytes()}
    found = posted(vrm_browser, VRM_WEB, "avatar.html?animation=1", files)
    head = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]) @ rows[0, 53:62].reshape(3, 3))
    weights = torch.tensor(rows[:1, 1:53], dtype=torch.float32)
    clips = dict(zip(VRM1.names, VRM1.from_arkit(weights)[0].tolist(), strict=True))
    expected = {} if own == "JawOpen" else {n: clips[n] for n in expressions}
    if own:  # VRM's presets pucker already
        expected[own] = 0.0 if own == "MouthPucker" else float(weights[0, ARKIT.index(own[0].lower() + own[1:])])
    assert_posed(found, head, expected)
    if own:
        return
    # The same by VMC, as python-osc decodes it and UniVRM takes it over from Unity, whose x axis is turned round.
    angles = torch.tensor(rows[0, 53:62], dtype=torch.float64).reshape(3, 3)
    rotations = torch.cat([head_angles(angles), torch.zeros(6, dtype=torch.float64)])
    sent = values_by_address(VmcPackets(ARKIT)(weights[0], rotations))
    turns = {name[0].lower() + name[1:]: turn for name, _, _, _, *turn in sent["/VMC/Ext/Bone/Pos"]}
    bones = {name: [x, -y, -z, w] for name, (x, y, z, w) in turns.items() if "Eye" not in name}
    pose = json.dumps({"bones": bones, "clips": dict(sent["/VMC/Ext/Blend/Val"])}).encode()
    files = {"/avatar.vrm": avatar.read_bytes(), "/pose.json": pose}
    assert_posed(posted(vrm_browser, VRM_WEB, "avatar.html?pose=1", files), head, expected)


def assert_posed(found: dict[str, Any], head: Rotation, expressions: dict[str, float]) -> None:
    """Neck and head together are turned as the head is, the neck by 0.3 of it."""
    neck = Rotation.from_quat(found["turned"]["neck"])
    assert (head.inv() * neck * Rotation.from_quat(found["turned"]["head"])).magnitude() < 1e-3
    assert (Rotation.from_rotvec(0.3 * head.as_rotvec()).inv() * neck).magnitude() < 1e-3
    for name, value in expressions.items():
        assert found["shown"][name] == pytest.approx(value, abs=1e-3), name


def animated(path: Path) -> dict[tuple[str, str], np.ndarray]:
    """The keys of a file's first animation by the name of the node and what of it moves."""
    document = read_document(path)
    nodes, animation = document.objects("nodes"), document.objects("animations")[0]
    outputs = [
        read_floats(document, sampler["output"], "output", ("SCALAR", "VEC4")) for sampler in animation["samplers"]
    ]
    targets = [(channel["target"], outputs[channel["sampler"]]) for channel in animation["channels"]]
    return {(nodes[target["node"]].get("name", ""), target["path"]): keys.reshape(-1) for target, keys in targets}


@pytest.mark.parametrize("bone", ["Head", "LeftEye"])
def test_an_eye_whose_skin_looks_by_shapes_is_not_turned_too(run: Run, tmp_path: Path, bone: str) -> None:
    """Lids that are bound to the head leave the eye to its bone; page and Python decide alike."""
    path = sheet(tmp_path / "skinned.glb", ("jawOpen", "eyeLookUpLeft"))
    root, binary = unpacked(path)
    first, at = len(root["nodes"]), len(binary)
    (primitive,) = root["meshes"][0]["primitives"]
    count = root["accessors"][primitive["attributes"]["POSITION"]]["count"]
    joints, weights = np.zeros((count, 4), np.uint8), np.zeros((count, 4), np.float32)
    joints[:, 0], weights[:, 0] = ("Head", "LeftEye", "RightEye").index(bone), 1.0
    for name, values, kind in (("JOINTS_0", joints, 5121), ("WEIGHTS_0", weights, 5126)):
        root["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes})
        view = {"bufferView": len(root["bufferViews"]) - 1, "componentType": kind, "count": count, "type": "VEC4"}
        primitive["attributes"][name] = len(root["accessors"])
        root["accessors"].append(view)
        binary += values.tobytes()
    root["buffers"][0]["byteLength"] += len(binary) - at
    root["nodes"] += [{"name": "Head", "children": [first + 1, first + 2]}, {"name": "LeftEye"}, {"name": "RightEye"}]
    root["nodes"][0]["skin"], root["skins"] = 0, [{"joints": [first, first + 1, first + 2]}]
    root["scenes"][0]["nodes"].append(first)
    path.write_bytes(packed(root, binary))
    (tmp_path / "page.glb").write_bytes(saved(run, {"glb": str(path), "rows": planted_rows().tolist()}, ".glb"))
    played = Performance(np.arange(2.0), ("jawOpen",), np.zeros((2, 1), np.float32), np.full((2, 9), 0.1))
    (tmp_path / "python.glb").write_bytes(performed_glb(read_document(path), played))
    turned = {"Head", "RightEye"} | ({"LeftEye"} if bone == "Head" else set())
    for name in ("page.glb", "python.glb"):
        assert {node for node, way in animated(tmp_path / name) if way == "rotation"} == turned, name


def document(path: Path, **fields: object) -> Path:
    """A ``.glb`` of a document with these fields alone."""
    text = json.dumps({"asset": {"version": "2.0"}, **fields}).encode()
    text += b" " * (-len(text) % 4)
    path.write_bytes(struct.pack("<IIIII", 0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A) + text)
    return path


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"buffers": [{"uri": "face.bin", "byteLength": 4}]}, "lie in other files"),
        ({"images": [{"uri": "https://elsewhere.test/skin.png"}]}, "lie in other files"),
        ({"meshes": [{"primitives": [{}]}]}, "no morph targets"),
        ({}, "no morph targets"),
    ],
)
def test_files_that_the_page_cannot_use_are_told(run: Run, tmp_path: Path, fields: dict, words: str) -> None:
    assert words in run("refusal", document(tmp_path / "file.glb", **fields))


def test_shapes_that_would_fill_the_memory_are_refused(run: Run, tmp_path: Path) -> None:
    mesh = {"primitives": [{"targets": [{"POSITION": 0}] * 60}], "extras": {"targetNames": ["jawOpen"] * 60}}
    path = document(tmp_path / "file.glb", meshes=[mesh], accessors=[{"count": 10**6}])
    assert "too large" in run("refusal", path)
