"""What others make of our files: Khronos' validator and three.js, both from npm."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rig_samples import corrective_sheet, quad_sheet, sheet_rig, sheet_take
from test_primitive_writing import head

from torchface import BlendshapeRig, Mesh, load_rig, save_animation, save_mesh, save_rig
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.tangent_space import tangent_space
from torchface.io.gltf.part_textures.head_primitives import surfaces
from torchface.synthetic import performer

WEB = Path(__file__).resolve().parent / "web"
pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The path of node, with the packages installed in ``web``; kept there for the next run."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("node and npm are not installed; the validator and three.js come from npm")
    wanted = (WEB / "package-lock.json").read_text()
    mark = WEB / "node_modules" / ".torchface-lock.json"
    if not mark.is_file() or mark.read_text() != wanted:
        installed = subprocess.run(
            [npm, "ci", "--no-audit", "--no-fund"], cwd=WEB, capture_output=True, text=True, timeout=300, check=False
        )
        if installed.returncode != 0:
            pytest.skip(f"npm could not install the validator and three.js: {installed.stderr[-300:]}")
        mark.write_text(wanted)
    return node


def run(node: str, script: str, path: Path, *words: str) -> dict:
    done = subprocess.run(
        [node, WEB / script, path, *words], cwd=WEB, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout)


def assert_valid(node: str, path: Path) -> None:
    issues = run(node, "validate.mjs", path)["issues"]
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


def assert_three_moves_it_alike(node: str, path: Path, rig: BlendshapeRig, weights: torch.Tensor) -> None:
    seen = run(node, "load.mjs", path, *[f"{weight:.9g}" for weight in weights.tolist()])["meshes"]
    assert len(seen) == 1
    assert tuple(seen[0]["names"]) == rig.names
    corners = np.array(seen[0]["positions"]).reshape(-1, 3)[np.array(seen[0]["indices"]).reshape(-1, 3)]
    expected = rig(weights[None])[0][rig.neutral.faces].numpy() / 1000
    assert np.abs(corners - expected).max() < 1e-5


def test_a_small_rig_is_valid_and_moves_alike_in_three(node: str, tmp_path: Path) -> None:
    rig = sheet_rig()
    save_rig(rig, tmp_path / "rig.glb")
    assert_valid(node, tmp_path / "rig.glb")
    assert_three_moves_it_alike(node, tmp_path / "rig.glb", rig, torch.tensor([0.5, 0.25, 1.0]))
    seen = run(node, "load.mjs", tmp_path / "rig.glb")
    assert seen["meshes"][0]["textured"]
    assert seen["pictures"] == 1


def test_three_plays_correctives_as_the_rig_does(node: str, tmp_path: Path) -> None:
    rig = corrective_sheet()
    assert rig.activation is not None
    save_rig(rig, tmp_path / "rig.glb")
    assert_valid(node, tmp_path / "rig.glb")
    weights = torch.tensor([[0.5, 0.25, 1.0]])
    every = torch.cat([weights, rig.activation(weights)], 1)[0]
    seen = run(node, "load.mjs", tmp_path / "rig.glb", *[f"{weight:.9g}" for weight in every.tolist()])["meshes"]
    corners = np.array(seen[0]["positions"]).reshape(-1, 3)[np.array(seen[0]["indices"]).reshape(-1, 3)]
    assert np.abs(corners - rig(weights)[0][rig.neutral.faces].numpy() / 1000).max() < 1e-5


def assert_parts_are_valid_and_three_moves_them(node: str, path: Path, rig: BlendshapeRig) -> None:
    save_rig(rig, path)
    assert_valid(node, path)
    weights = torch.linspace(0.3, 0.9, len(rig.names))
    seen = run(node, "load.mjs", path, *[f"{weight:.9g}" for weight in weights.tolist()])["meshes"]
    parts = surfaces(rig.neutral, rig.neutral.texture is not None)
    rows = [
        part.triangles for name in dict.fromkeys(part.part for part in parts) for part in parts if part.part == name
    ]
    assert len(seen) == len(rows)
    moved = rig(weights[None])[0].numpy() / 1000
    for mesh, triangles in zip(seen, rows, strict=True):
        assert tuple(mesh["names"]) == rig.names
        corners = np.array(mesh["positions"]).reshape(-1, 3)[np.array(mesh["indices"]).reshape(-1, 3)]
        assert np.abs(corners - moved[rig.neutral.faces[triangles]]).max() < 1e-5


def test_a_head_of_parts_is_valid_and_moves_alike_in_three(node: str, tmp_path: Path) -> None:
    assert_parts_are_valid_and_three_moves_them(node, tmp_path / "head.glb", head())
    assert_parts_are_valid_and_three_moves_them(node, tmp_path / "plain.glb", head(textured=False, colored=False))
    assert_parts_are_valid_and_three_moves_them(
        node, tmp_path / "all.glb", performer().select(["jawOpen", "eyeBlinkLeft"])
    )


@pytest.mark.bench
@pytest.mark.real
def test_a_real_head_of_parts_is_valid_and_moves_alike_in_three(node: str, tmp_path: Path, ict_folder: Path) -> None:
    rig = load_rig(ict_folder, shapes=["jawOpen", "eyeBlink_L"])
    assert_parts_are_valid_and_three_moves_them(node, tmp_path / "ict.glb", rig)


def test_a_bare_mesh_with_loose_vertices_is_valid(node: str, tmp_path: Path) -> None:
    mesh = quad_sheet()
    bare = Mesh(torch.cat([mesh.vertices, torch.tensor([[0.0, 99.0, 0.0]])]), mesh.faces, mesh.uvs, mesh.uv_faces)
    save_mesh(bare, tmp_path / "bare.glb")
    assert_valid(node, tmp_path / "bare.glb")


def test_an_animation_is_valid_and_plays_in_three(node: str, tmp_path: Path) -> None:
    rig, take = sheet_rig(), sheet_take(frames=61)
    save_animation(rig, take, tmp_path / "take.glb")
    assert_valid(node, tmp_path / "take.glb")
    seen = run(node, "load.mjs", tmp_path / "take.glb")
    assert seen["animations"] == [{"duration": pytest.approx(1.0), "tracks": 1}]
    middle = take.weights.values[30, :, 0]
    assert seen["halfway"] == pytest.approx([float(middle[2]), float(middle[0]), 0.0], abs=1e-4)


def test_wrinkle_maps_are_valid_and_three_shows_the_neutrals(node: str, tmp_path: Path) -> None:
    rig = sheet_rig()
    maps = torch.nn.functional.normalize(torch.rand(3, 3, 16, 16, generator=torch.Generator().manual_seed(0)), dim=1)
    save_rig(rig, tmp_path / "rig.glb", DetailMaps(rig.names[:2], maps[:2], maps[2]))
    assert_valid(node, tmp_path / "rig.glb")
    seen = run(node, "load.mjs", tmp_path / "rig.glb")["meshes"][0]
    assert seen["normalMapped"]
    assert "tangent" in seen["attributes"]
    assert [entry["shape"] for entry in seen["extras"]["wrinkleMaps"]] == list(rig.names[:2])


def assert_tangents_are_mikktspaces(node: str, folder: Path, mesh: Mesh) -> None:
    points, uvs = mesh.vertices.double(), mesh.uvs.double()
    normals = vertex_normals(points, mesh.faces)
    space = tangent_space(points, mesh.faces, uvs, mesh.uv_faces, normals)
    upper_left = torch.stack([uvs[:, 0], 1 - uvs[:, 1]], dim=1)
    rows = {"positions": points[mesh.faces], "normals": normals[mesh.faces], "uvs": upper_left[mesh.uv_faces]}
    (folder / "corners.json").write_text(json.dumps({name: row.flatten().tolist() for name, row in rows.items()}))
    expected = torch.tensor(run(node, "tangents.mjs", folder / "corners.json")).view(-1, 3, 4).double()
    cosine = (space.tangents[space.tangent_faces] * expected[..., :3]).sum(-1)
    assert float(torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).max()) < 0.1
    # Its sign is about texture coordinates whose origin is at the upper left, glTF's the other way.
    assert torch.equal(space.signs[space.tangent_faces], -expected[..., 3])


def test_tangents_are_the_ones_that_viewers_compute(node: str, tmp_path: Path) -> None:
    mesh = quad_sheet()
    bent = mesh.with_vertices(
        mesh.vertices + torch.randn(mesh.vertices.shape, generator=torch.Generator().manual_seed(0))
    )
    assert_tangents_are_mikktspaces(node, tmp_path, bent)
    assert_tangents_are_mikktspaces(node, tmp_path, replace(bent, uvs=(mesh.uvs - 0.5).abs() + 0.1 * mesh.uvs))


@pytest.mark.bench
@pytest.mark.real
def test_tangents_of_a_real_face_are_the_ones_that_viewers_compute(node: str, tmp_path: Path, ict_folder: Path) -> None:
    assert_tangents_are_mikktspaces(node, tmp_path, load_rig(ict_folder, part="face").neutral)


@pytest.mark.real
def test_a_real_face_is_valid_and_moves_alike_in_three(node: str, tmp_path: Path, ict_folder: Path) -> None:
    rig = load_rig(ict_folder, part="face")
    save_rig(rig, tmp_path / "ict.glb")
    assert_valid(node, tmp_path / "ict.glb")
    weights = torch.rand(len(rig.names), generator=torch.Generator().manual_seed(0)) * 0.5
    assert_three_moves_it_alike(node, tmp_path / "ict.glb", rig, weights)
