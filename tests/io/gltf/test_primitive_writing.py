"""A head's parts as engines get them: primitives, materials, pivots, turned normals; and back as one rig."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from torch import Tensor

from planted.glb_files import packed, unpacked
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io import load_detail_maps, load_mesh, load_rig, save_animation, save_mesh, save_rig
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.gltf.part_textures.head_primitives import painted_lashes, surfaces
from torchface.io.gltf.part_textures.iris_texture import eye_centre
from torchface.mesh import Annotations, Mesh
from torchface.part_materials import EYELASHES
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer
from torchface.take import Take, Track


def ball(
    centre: tuple[float, float, float], radius: float, bulge: float = 0.0, rows: int = 14
) -> tuple[Tensor, Tensor]:
    """Vertices and triangles of a sphere about z, its front pushed out by ``bulge`` as a cornea is."""
    polar, turn = torch.linspace(0.05, 3.09, rows), torch.arange(20) / 20 * 2 * torch.pi
    p, t = (values.flatten() for values in torch.meshgrid(polar, turn, indexing="ij"))
    reach = radius + bulge * (1 - (p / 0.45) ** 2).clamp(min=0)
    way = torch.stack([p.sin() * t.cos(), p.sin() * t.sin(), p.cos()], dim=1)
    row, column = (
        values.flatten() for values in torch.meshgrid(torch.arange(rows - 1), torch.arange(20), indexing="ij")
    )
    a, b = row * 20 + column, row * 20 + (column + 1) % 20
    faces = torch.cat([torch.stack([a, a + 20, b + 20], 1), torch.stack([a, b + 20, b], 1)])
    return way * reach[:, None] + torch.tensor(centre), faces


def sheet(z: float, side: int = 7) -> tuple[Tensor, Tensor]:
    y, x = torch.meshgrid(torch.linspace(-50, 50, side), torch.linspace(-50, 50, side), indexing="ij")
    corner = (torch.arange(side - 1)[:, None] * side + torch.arange(side - 1)).flatten()
    faces = (
        torch.stack([corner, corner + 1, corner + side + 1], 1),
        torch.stack([corner, corner + side + 1, corner + side], 1),
    )
    return torch.stack([x, y, torch.full_like(x, z)], dim=-1).reshape(-1, 3), torch.cat(faces)


def head(textured: bool = True, colored: bool = True) -> BlendshapeRig:
    """A plate of skin with an eye of two shells, teeth, fluid, and more skin in the next tile, laid out as UDIM.

    The eye's chart lies on the face's, as ICT-FaceKit's do.
    """
    pieces = {
        "face": (*sheet(0.0), 0),
        "eyeball_left": (*ball((12.0, 5.0, 8.0), 12.0, bulge=1.2), 0),
        "iris": (*ball((12.0, 5.0, 8.0), 11.0), 0),
        "teeth": (*sheet(-20.0), 3),
        "neck": (*sheet(-30.0), 1),
        "lacrimal_fluid_left": (*sheet(22.0, 3), 4),
    }
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in pieces.values())]).tolist()
    vertices = torch.cat([vertices for vertices, _, _ in pieces.values()])
    faces = torch.cat([faces + start for (_, faces, _), start in zip(pieces.values(), starts, strict=False)])
    flat = [(v[:, :2] - v[:, :2].amin(0)) / (v[:, :2].amax(0) - v[:, :2].amin(0)) for v, _, _ in pieces.values()]
    uvs = torch.cat(
        [
            uv * 0.98 + 0.01 + torch.tensor([float(tile), 0.0])
            for uv, (_, _, tile) in zip(flat, pieces.values(), strict=True)
        ]
    )
    ids = torch.arange(len(vertices))
    regions = {name: (ids >= a) & (ids < b) for name, a, b in zip(pieces, starts[:-1], starts[1:], strict=True)}
    regions["eyeball_left"] |= regions.pop("iris")
    shuffled = torch.randperm(
        len(vertices), generator=torch.Generator().manual_seed(0)
    )  # parts need not follow each other
    back = shuffled.argsort()
    skin = len(pieces["face"][1])  # comes first, as where textures are baked: the first triangle has a texel
    order = torch.randperm(len(faces) - skin, generator=torch.Generator().manual_seed(1)) + skin
    order = torch.cat([torch.arange(skin), order])
    picture = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(2)) * 0.2 + 0.5
    mesh = Mesh(
        vertices[shuffled],
        back[faces][order],
        uvs,
        faces[order],
        colors=torch.rand(len(vertices), 3, generator=torch.Generator().manual_seed(3)) if colored else None,
        texture=picture if textured else None,
        annotations=Annotations(
            back[torch.tensor([3, 7, 400])], {name: mask[shuffled] for name, mask in regions.items()}
        ),
    )
    deltas = torch.randn(2, len(vertices), 3, generator=torch.Generator().manual_seed(4))
    deltas[1, ~mesh.annotations.regions["face"]] = 0
    return BlendshapeRig(mesh, deltas, ("jawOpen", "mouthSmileLeft"))


class Written:
    """A written file's JSON and accessors."""

    def __init__(self, path: Path) -> None:
        self.root, self.data = unpacked(path)

    def bytes(self, view: int, kind: str) -> np.ndarray:
        row = self.root["bufferViews"][view]
        return np.frombuffer(self.data, kind, row["byteLength"] // np.dtype(kind).itemsize, row["byteOffset"])

    def rows(self, index: int) -> np.ndarray:
        accessor = self.root["accessors"][index]
        kind = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        rows = np.zeros((accessor["count"], width), kind)
        if "bufferView" in accessor:
            rows = self.bytes(accessor["bufferView"], kind).reshape(-1, width).copy()
        if sparse := accessor.get("sparse"):
            index_kind = {5125: "<u4", 5123: "<u2"}[sparse["indices"]["componentType"]]
            at = self.bytes(sparse["indices"]["bufferView"], index_kind)
            rows[at] = self.bytes(sparse["values"]["bufferView"], kind).reshape(-1, width)
        return rows

    def primitives(self) -> dict[str, list[dict[str, Any]]]:
        """By the name of the material."""
        found: dict[str, list[dict[str, Any]]] = {}
        for mesh in self.root["meshes"]:
            for primitive in mesh["primitives"]:
                found.setdefault(self.root["materials"][primitive["material"]]["name"], []).append(primitive)
        return found

    def look(self, primitive: dict[str, Any]) -> dict[str, Any]:
        return self.root["materials"][primitive["material"]]["pbrMetallicRoughness"]


@pytest.mark.parametrize(("textured", "colored"), [(True, True), (True, False), (False, True), (False, False)])
def test_a_head_of_parts_comes_back_as_the_same_rig(textured: bool, colored: bool, tmp_path: Path) -> None:
    rig = head(textured, colored)
    save_rig(rig, tmp_path / "head.glb")
    found, mesh = load_rig(tmp_path / "head.glb"), rig.neutral
    assert found.names == rig.names
    assert torch.equal(found.neutral.faces, mesh.faces)
    assert (found.vertices - mesh.vertices).abs().max() < 1e-4
    assert (found.deltas - rig.deltas).abs().max() < 2e-4
    assert torch.equal(found.neutral.landmarks, mesh.landmarks)
    assert all(
        torch.equal(found.neutral.annotations.regions[name], mask) for name, mask in mesh.annotations.regions.items()
    )
    assert (found.neutral.uvs[found.neutral.uv_faces] - mesh.uvs[mesh.uv_faces]).abs().max() < 1e-6
    assert len(found.neutral.uvs) == len(mesh.uvs)  # no seam where primitives meet
    # What is painted on eyes for engines is not the mesh's own.
    assert (found.neutral.texture is not None) == textured
    assert not textured or (found.neutral.texture - mesh.texture).abs().max() <= 0.5 / 255 + 1e-6
    assert (found.neutral.colors is not None) == colored
    assert not colored or (found.neutral.colors - mesh.colors).abs().max() < 1e-5


def test_no_part_wears_anothers_texels_and_no_texture_is_multiplied(tmp_path: Path) -> None:
    save_rig(head(), tmp_path / "head.glb")
    written = Written(tmp_path / "head.glb")
    found = written.primitives()
    assert sorted(found) == ["cornea", "iris", "lacrimal_fluid", "sclera", "skin", "teeth"]
    face, neck = found["skin"]
    assert written.look(face)["baseColorTexture"] == {"index": 0}
    uvs = written.rows(face["attributes"]["TEXCOORD_0"])
    assert uvs.min() >= 0
    assert uvs.max() <= 1
    # The next tile has no picture: it wears the colours of the vertices.
    assert "baseColorTexture" not in written.look(neck)
    assert "COLOR_0" in neck["attributes"]
    for primitive in [row for rows in found.values() for row in rows]:
        assert not ("COLOR_0" in primitive["attributes"] and "baseColorTexture" in written.look(primitive))
    pictures = {name: written.look(rows[0]).get("baseColorTexture", {}).get("index") for name, rows in found.items()}
    assert pictures["teeth"] is None
    assert len({pictures["skin"], pictures["sclera"], pictures["iris"]}) == 3
    assert (
        written.look(found["teeth"][0])["baseColorFactor"][:3]
        != written.look(found["lacrimal_fluid"][0])["baseColorFactor"][:3]
    )
    modes = {row["name"]: row.get("alphaMode", "OPAQUE") for row in written.root["materials"]}
    assert modes["lacrimal_fluid"] == modes["cornea"] == "BLEND"
    assert modes["teeth"] == modes["skin"] == "OPAQUE"
    assert written.look(found["lacrimal_fluid"][0])["baseColorFactor"][3] < 0.3


def test_eyeballs_hang_on_pivots_at_their_centres(tmp_path: Path) -> None:
    rig = head()
    save_rig(rig, tmp_path / "head.glb")
    nodes = Written(tmp_path / "head.glb").root["nodes"]
    assert [node["name"] for node in nodes] == ["face", "eyeball_left"]
    assert nodes[0]["children"] == [1]
    assert np.abs(np.array(nodes[1]["translation"]) - np.array([12.0, 5.0, 8.0]) / 1000).max() < 1e-4
    triangles = rig.neutral.annotations.regions["eyeball_left"][rig.neutral.faces].all(1).nonzero()[:, 0]
    centre = eye_centre(rig.neutral, triangles)  # the cornea's bulge does not draw it forward
    assert (centre - torch.tensor([12.0, 5.0, 8.0])).abs().max() < 0.1


def test_other_readers_find_the_parts_where_they_are(tmp_path: Path) -> None:
    rig = head()
    save_rig(rig, tmp_path / "head.glb")
    other = pygltflib.GLTF2().load(tmp_path / "head.glb")
    assert [node.name for node in other.nodes] == ["face", "eyeball_left"]
    assert all(mesh.extras["targetNames"] == list(rig.names) for mesh in other.meshes)
    scene = trimesh.load(tmp_path / "head.glb", process=False)
    shown = torch.from_numpy(np.concatenate([piece.triangles for piece in scene.dump()])).float() * 1000
    ours = rig.vertices[rig.neutral.faces]
    found, expected = (
        rows.reshape(len(ours), 9)[np.lexsort(rows.reshape(len(ours), 9).round(decimals=2).numpy().T)]
        for rows in (shown, ours)
    )
    assert (found - expected).abs().max() < 1e-2


def test_normals_of_a_shape_are_those_of_the_moved_surface(tmp_path: Path) -> None:
    rig = head()
    save_rig(rig, tmp_path / "head.glb")
    written = Written(tmp_path / "head.glb")
    for number, delta in enumerate(rig.deltas.double()):
        expected = vertex_normals(rig.vertices.double() + delta, rig.neutral.faces).numpy()
        for mesh in written.root["meshes"]:
            for primitive in mesh["primitives"]:
                vertex = written.rows(primitive["attributes"]["_VERTEX_ID"])[:, 0].astype(int)
                normal = written.rows(primitive["attributes"]["NORMAL"]) + written.rows(
                    primitive["targets"][number]["NORMAL"]
                )
                assert np.abs(normal - expected[vertex]).max() < 0.005


def test_an_animation_moves_every_part_and_is_read_back(tmp_path: Path) -> None:
    weights = torch.rand(9, 2, 1, generator=torch.Generator().manual_seed(0))
    rig = head()
    save_animation(rig, Take(30.0, weights=Track(rig.names, weights)), tmp_path / "take.glb")
    channels = Written(tmp_path / "take.glb").root["animations"][0]["channels"]
    assert [channel["target"]["node"] for channel in channels] == [0, 1]
    found = read_gltf_weights(tmp_path / "take.glb")
    assert torch.equal(found.weights.values, weights)


def test_normal_maps_lie_on_the_skin_that_they_were_baked_on(tmp_path: Path) -> None:
    rig = head(textured=False)
    flat = torch.zeros(2, 3, 16, 16)
    flat[:, 2] = 1
    save_rig(rig, tmp_path / "head.glb", DetailMaps(("jawOpen",), flat[:1], flat[1]))
    written = Written(tmp_path / "head.glb")
    mapped = [
        row
        for rows in written.primitives().values()
        for row in rows
        if "normalTexture" in written.root["materials"][row["material"]]
    ]
    assert len(mapped) == 1
    assert "TANGENT" in mapped[0]["attributes"]
    assert written.rows(mapped[0]["attributes"]["TEXCOORD_0"]).max() <= 1
    maps = load_detail_maps(tmp_path / "head.glb")
    assert maps.names == ("jawOpen",)


def test_a_part_that_owns_its_texels_keeps_them(tmp_path: Path) -> None:
    """The embedded performer's eyes and mouth are painted in the one texture of the head."""
    rig = performer().select(["jawOpen"])
    save_rig(rig, tmp_path / "performer.glb")
    written = Written(tmp_path / "performer.glb")
    assert {name: written.look(rows[0]).get("baseColorTexture") for name, rows in written.primitives().items()} == {
        name: {"index": 0} for name in ("skin", "mouth", "eye_socket", "eyeball")
    }
    assert len(written.root["images"]) == 1


def test_without_regions_a_mesh_stays_one_primitive(tmp_path: Path) -> None:
    rig = head()
    bare = BlendshapeRig(replace(rig.neutral, annotations=None), rig.deltas, rig.names)
    assert len(surfaces(bare.neutral, True)) == 1
    save_rig(bare, tmp_path / "bare.glb")
    assert len(Written(tmp_path / "bare.glb").root["meshes"][0]["primitives"]) == 1
    assert torch.equal(load_rig(tmp_path / "bare.glb").neutral.faces, rig.neutral.faces)


def test_an_eyeball_of_shells_too_coarse_for_a_cornea_is_written(tmp_path: Path) -> None:
    shells = [trimesh.creation.icosphere(subdivisions=0, radius=radius) for radius in (12.0, 11.0)]
    skin = trimesh.Trimesh([[50, 0, 0], [60, 0, 0], [50, 10, 0]], [[0, 1, 2]])
    whole = trimesh.util.concatenate([*shells, skin])
    notes = Annotations(regions={"eyeball_left": torch.arange(len(whole.vertices)) < 24})
    mesh = Mesh(torch.tensor(whole.vertices).float(), torch.tensor(whole.faces).long(), annotations=notes)
    save_mesh(mesh, tmp_path / "eye.glb")
    assert torch.equal(load_mesh(tmp_path / "eye.glb").faces, mesh.faces)


def test_parts_that_another_program_edited_are_still_read(tmp_path: Path) -> None:
    """Without our marks the file is a scene of several meshes, each a region, at the places that it shows."""
    rig = head()
    save_rig(rig, tmp_path / "head.glb")
    data = (tmp_path / "head.glb").read_bytes().replace(b"_VERTEX_ID", b"_ANOTHER_A")
    (tmp_path / "other.glb").write_bytes(data)
    found = load_rig(tmp_path / "other.glb")
    assert list(found.neutral.annotations.regions) == ["face", "eyeball_left"]
    places = found.neutral.vertices[found.neutral.annotations.regions["eyeball_left"]]
    assert (places.mean(0) - rig.vertices[rig.neutral.annotations.regions["eyeball_left"]].mean(0)).abs().max() < 1.0
    assert len(found.neutral.faces) == len(rig.neutral.faces)


def test_a_broken_order_of_triangles_is_no_order(tmp_path: Path) -> None:
    save_rig(head(), tmp_path / "head.glb")
    root, binary = unpacked(tmp_path / "head.glb")
    runs = root["meshes"][0]["extras"]["torchface"]["triangles"]
    for broken in ([[0, 10**12]], runs[1:], [*runs[:-1], [runs[-1][0], 10**9]], [[0, 1]] * len(runs)):
        root["meshes"][0]["extras"]["torchface"]["triangles"] = broken
        (tmp_path / "b.glb").write_bytes(packed(root, binary))
        assert len(load_rig(tmp_path / "b.glb").neutral.faces) == len(head().neutral.faces)


def test_lashes_are_hairs_on_a_clear_ground() -> None:
    mesh = head().neutral
    lid, card = sheet(0.0), sheet(0.0)
    vertices = torch.cat([lid[0] - torch.tensor([0.0, 60.0, 0.0]), card[0] * torch.tensor([0.4, 0.08, 1.0])])
    faces = torch.cat([lid[1], card[1] + len(lid[0])])
    uvs = torch.cat([lid[0][:, :2], card[0][:, :2]]) / 102 + 0.5
    mesh = Mesh(vertices, faces, uvs, faces)
    paint = painted_lashes(mesh, torch.arange(len(lid[1]), len(faces)), EYELASHES)
    opacity = paint.image[3]
    inside = opacity[16:-16, 16:-16]
    root, tip = inside[-120:], inside[:120]  # the lid is below
    assert 0.2 < float(root.mean()) < 0.45
    assert float(tip.mean()) < 0.5 * float(root.mean())
    assert float(((inside > 0.05) & (inside < 0.95)).float().mean()) < 0.35
    faded = painted_lashes(Mesh(vertices, faces), torch.arange(len(lid[1]), len(faces)), EYELASHES).colors
    assert float(faded[len(lid[0]) + 3, 3]) == pytest.approx(0.6, abs=0.05)  # at the lid
    assert float(faded[-4, 3]) < 0.1


@pytest.mark.bench
@pytest.mark.real
def test_a_real_head_of_parts_comes_back_as_the_same_rig(ict_folder: Path, tmp_path: Path) -> None:
    rig = load_rig(ict_folder, shapes=["jawOpen", "eyeBlink_L"])
    save_rig(rig, tmp_path / "ict.glb")
    found, mesh = load_rig(tmp_path / "ict.glb"), rig.neutral
    assert torch.equal(found.neutral.polygons, mesh.polygons)
    assert (found.vertices - mesh.vertices).abs().max() < 1e-4
    assert (found.deltas - rig.deltas).abs().max() < 2e-4
    assert torch.equal(found.neutral.landmarks, mesh.landmarks)
    assert (found.neutral.uvs[found.neutral.uv_faces] - mesh.uvs[mesh.uv_faces]).abs().max() < 1e-6
    written = Written(tmp_path / "ict.glb")
    for rows in written.primitives().values():
        for primitive in rows:
            if "baseColorTexture" in written.look(primitive):
                tiles = np.floor(written.rows(primitive["attributes"]["TEXCOORD_0"]).mean(0))
                uvs = written.rows(primitive["attributes"]["TEXCOORD_0"]) - tiles
                assert uvs.min() >= 0
                assert uvs.max() <= 1
    assert [node["name"] for node in written.root["nodes"]] == ["face", "eyeball_left", "eyeball_right"]
