"""The page's own modules under Node: names, calibration, times, characters."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rig_samples import quad_sheet

from torchface import BlendshapeRig
from torchface.errors import MissingExtraError
from torchface.io import save_rig
from torchface.progress import silent
from torchface.shape_names import ARKIT, mapping
from torchface.workflows.browser_app.built_page import installed_packages, page_sources

pytestmark = pytest.mark.browser
Run = Callable[[str, object], Any]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs a job of ``modules.mjs``; skips visibly where node or the page's packages are missing."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("node and npm are not installed")
    folder = tmp_path_factory.mktemp("modules")
    try:
        (folder / "node_modules").symlink_to(installed_packages(page_sources(), npm, silent) / "node_modules")
    except MissingExtraError as error:
        pytest.skip(f"the page's packages cannot be installed here: {error}")
    shutil.copytree(page_sources() / "src", folder / "src")
    shutil.copy(page_sources() / "package.json", folder)
    shutil.copy(Path(__file__).parent / "modules.mjs", folder)

    def run(job: str, data: object) -> Any:
        path = data if isinstance(data, Path) else folder / "input.json"
        if path is not data:
            path.write_text(json.dumps(data))
        command = [node, "modules.mjs", str(folder), job, str(path)]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr[-3000:]
        return json.loads(done.stdout)

    return run


def test_names_are_taken_as_torchface_takes_them(run: Run) -> None:
    names = [*ARKIT, "EyeBlinkLeft", "eyeBlink_L", "browInnerUp_L", "browInnerUp_R", "cheekPuff_R", "mouthSmile"]
    names += ["eyeBlink", "jawOpenLeft", "antenna", "tongueout", "jaw", "left", "_L"]
    told = run("names", names)
    assert tuple(told["arkit"]) == ARKIT
    found = torch.zeros(len(names), len(ARKIT))
    for row, sources in enumerate(told["sources"]):
        for column, factor in sources:
            found[row, column] = factor
    torch.testing.assert_close(found, mapping(ARKIT, names))


def test_calibration_takes_ten_seconds_of_a_face_that_is_seen(run: Run) -> None:
    frames = [(1000 * i / 30, not 60 <= i < 105) for i in range(500)]  # 1.5 s without a face
    told = run("calibration", frames)
    assert abs(told["done"] / 1000 - 11.5) < 0.3
    assert len(told["prompts"]) == 5
    poses = np.array(told["poses"])
    order = poses[np.flatnonzero(np.diff(poses, prepend=-1))]
    assert order.tolist() == [0, 1, 0, 2, 0, 3, 0, 4, 0, 5]
    held = np.bincount(poses, minlength=6)[1:] / 30
    assert held.min() > 1.2


def test_times_rise_and_the_rate_is_a_usual_one(run: Run) -> None:
    times = [5000 + 1000 * i / 29.7 for i in range(40)]
    told = run("take", [*times[:10], times[3], times[9], *times[10:]])
    np.testing.assert_allclose(told["seconds"], (np.array(times) - 5000) / 1000, atol=1e-5)
    assert told["rate"] == 30


def test_slow_drawing_takes_a_third_of_the_time_at_most_and_becomes_coarser_where_that_helps(run: Run) -> None:
    quick = [(3.0, 0.0)] * 50
    took, rests, ratios = np.array(run("pace", [*quick, (5000.0, 0.0), *quick, *[(5.0, 20.0)] * 40])).T
    assert not rests[took < 4].any()
    assert rests[50] < 1000  # the first drawing takes seconds, and the character is awaited
    assert (ratios[:101] == 2).all()  # one slow drawing is none
    slow = took[101:] > 12
    assert (took[101:] / (took + rests)[101:])[slow].max() < 1 / 3
    assert 0.5 <= ratios[-1] < 0.7
    assert not slow[-1]
    of_corners = np.array(run("pace", [(60.0, 1.0)] * 40))
    assert (of_corners[:, 2] < 2).any()
    assert (of_corners[20:, 2] == 2).all()  # fewer pixels were no quicker


def sheet(path: Path, names: tuple[str, ...]) -> Path:
    mesh = quad_sheet()
    deltas = torch.randn(len(names), len(mesh.vertices), 3, generator=torch.Generator().manual_seed(0))
    save_rig(BlendshapeRig(mesh, deltas, names), path)
    return path


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


def test_eyes_that_no_shape_moves_turn_in_the_head(run: Run, tmp_path: Path) -> None:
    data = sheet(tmp_path / "sheet.glb", ("jawOpen",)).read_bytes()

    def with_eye(root: dict[str, Any]) -> None:
        root["nodes"][0]["children"] = [1]
        root["nodes"].append({"name": "LeftEye", "translation": [0.01, 0.02, 0.03]})

    way = run("pose", edited(data, tmp_path / "eye.glb", with_eye))["ways"]["LeftEye"]
    x, y, z = np.sin(0.2) * np.cos(0.1), np.sin(0.1), np.cos(0.2) * np.cos(0.1)  # 0.2 to the person's left, 0.1 up
    expected = [np.cos(0.3) * x + np.sin(0.3) * z, y, np.cos(0.3) * z - np.sin(0.3) * x]
    np.testing.assert_allclose(way, expected, atol=1e-6)


def edited(data: bytes, path: Path, edit: Callable[[dict[str, Any]], None]) -> Path:
    """A ``.glb`` with its document changed."""
    (size,) = struct.unpack("<I", data[12:16])
    root = json.loads(data[20 : 20 + size])
    edit(root)
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    head = struct.pack("<IIIII", 0x46546C67, 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    path.write_bytes(head + text + rest)
    return path


def document(path: Path, **fields: object) -> Path:
    """A ``.glb`` of a document with these fields alone."""
    text = json.dumps({"asset": {"version": "2.0"}, **fields}).encode()
    text += b" " * (-len(text) % 4)
    path.write_bytes(struct.pack("<IIIII", 0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A) + text)
    return path


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "compressed with Draco"),
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
