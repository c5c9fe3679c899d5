from pathlib import Path

import numpy as np
import pygltflib
import pytest
import torch
from gltf_samples import LIFT, SQUARE, SQUARE_TRIANGLES, Builder, square

from torchface.io import load_mesh, load_rig
from torchface.io.gltf.character_scene import read_character
from torchface.io.gltf.gltf_document import read_document


def close(found: torch.Tensor, expected: object, within: float = 1e-3) -> bool:
    return bool((found - torch.as_tensor(np.asarray(expected))).abs().max() <= within)


@pytest.mark.parametrize("place", ["mesh", "primitive", "nowhere"])
def test_names_are_found_where_programs_put_them(place: str, tmp_path: Path) -> None:
    build = square(["jawOpen", "jawRight"] if place == "mesh" else None)
    if place == "primitive":
        build.root["meshes"][0]["primitives"][0]["extras"] = {"targetNames": ["jawOpen", "jawRight"]}
    rig = load_rig(build.save(tmp_path / "face.gltf"))
    assert rig.names == (("target_0", "target_1") if place == "nowhere" else ("jawOpen", "jawRight"))
    assert close(rig.neutral.vertices, SQUARE * 1000)
    assert close(rig.deltas[0], LIFT * 1000)
    assert close(load_rig(tmp_path / "face.gltf", unit="cm").neutral.vertices, SQUARE * 10)


def test_pygltflib_packs_the_same_rig_into_a_glb(tmp_path: Path) -> None:
    square(["a", "b"]).save(tmp_path / "face.gltf")
    other = pygltflib.GLTF2().load(tmp_path / "face.gltf")
    other.save_binary(tmp_path / "face.glb")
    rig = load_rig(tmp_path / "face.glb")
    assert rig.names == ("a", "b")
    assert close(rig.deltas[1], np.tile([[250.0, 0, 0]], (4, 1)))


def test_a_buffer_beside_the_document_is_read(tmp_path: Path) -> None:
    rig = load_rig(square(["a", "b"]).save_beside(tmp_path / "face.gltf", "data%20folder/face.bin"))
    assert close(rig.neutral.vertices, SQUARE * 1000)


def test_nodes_move_turn_and_scale_vertices_and_deltas(tmp_path: Path) -> None:
    build = square(["a", "b"])
    half = np.sqrt(0.5)
    build.root["nodes"] = [
        {"children": [1], "translation": [1, 2, 3]},
        {"children": [2], "rotation": [0, 0, half, half], "scale": [2, 2, 2]},  # a quarter turn about z
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0.5, 0, 0, 1]},
    ]
    rig = load_rig(build.save(tmp_path / "face.gltf"))
    moved = SQUARE + np.array([0.5, 0, 0])
    expected = np.stack([-2 * moved[:, 1], 2 * moved[:, 0], 2 * moved[:, 2]], axis=1) + np.array([1, 2, 3])
    assert close(rig.neutral.vertices, expected * 1000)
    assert close(rig.deltas[1], np.tile([[0, 500.0, 0]], (4, 1)))


def test_meshes_join_into_one_rig_and_shapes_of_one_name_into_one(tmp_path: Path) -> None:
    build = square(["jawOpen", "jawRight"])
    teeth = {
        "primitives": [
            {
                "attributes": {"POSITION": build.accessor(SQUARE[:3] + 5)},
                "targets": [{"POSITION": build.accessor(LIFT[:3])}],
            }
        ],
        "extras": {"targetNames": ["jawRight"]},
    }
    build.root["meshes"].append(teeth)
    build.root["nodes"] = [{"mesh": 0, "name": "head"}, {"mesh": 1, "name": "teeth"}]
    build.root["scenes"] = [{"nodes": [0, 1]}]
    rig = load_rig(build.save(tmp_path / "face.gltf"))
    assert rig.names == ("jawOpen", "jawRight")
    assert close(rig.neutral.vertices, np.concatenate([SQUARE, SQUARE[:3] + 5]) * 1000)
    assert close(rig.deltas[0], np.concatenate([LIFT, np.zeros((3, 3))]) * 1000)
    assert close(rig.deltas[1, 4:], LIFT[:3] * 1000)
    regions = rig.neutral.annotations.regions
    assert regions["teeth"].tolist() == [False] * 4 + [True] * 3
    assert len(load_rig(tmp_path / "face.gltf", part="teeth").neutral.vertices) == 3


def test_primitives_split_by_material_become_one_surface(tmp_path: Path) -> None:
    """Each primitive brings its own copies of the vertices on the border, as Blender writes them."""
    build = Builder()
    primitives = []
    for corners in ([0, 1, 2], [0, 2, 3]):
        primitives.append(
            {
                "attributes": {"POSITION": build.accessor(SQUARE[corners])},
                "indices": build.accessor(np.arange(3, dtype=np.uint8)),
                "targets": [{"POSITION": build.accessor(LIFT[corners])}],
            }
        )
    mesh = {"primitives": primitives, "extras": {"targetNames": ["a"]}}
    build.root |= {"meshes": [mesh], "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}]}
    rig = load_rig(build.save(tmp_path / "face.gltf"))
    assert close(rig.neutral.vertices, SQUARE * 1000)
    assert rig.neutral.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert close(rig.deltas[0], LIFT * 1000)


def test_primitives_that_share_vertices_do_not_double_them(tmp_path: Path) -> None:
    build = square(["a", "b"])
    first = build.root["meshes"][0]["primitives"][0]
    second = {**first, "indices": build.accessor(np.array([0, 1, 3], np.uint16))}
    build.root["meshes"][0]["primitives"].append(second)
    # A vertex that no position distinguishes from another: welding by position would join the two.
    rig = load_rig(build.save(tmp_path / "face.gltf"))
    assert len(rig.neutral.vertices) == 4
    assert rig.neutral.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 3]]


def test_sparse_accessors_replace_rows_with_and_without_a_base(tmp_path: Path) -> None:
    build = square(["a", "b"])
    indices = {"bufferView": build.view(np.array([1, 3], np.uint8).tobytes()), "componentType": 5121}
    values = {"bufferView": build.view(np.array([[1, 2, 3], [4, 5, 6]], np.float32).tobytes())}
    sparse = {"count": 2, "indices": indices, "values": values}
    targets = build.root["meshes"][0]["primitives"][0]["targets"]
    targets[0]["POSITION"] = build.bare(componentType=5126, count=4, type="VEC3", sparse=sparse)
    targets[1]["POSITION"] = build.accessor(LIFT, sparse=sparse)
    rig = load_rig(build.save(tmp_path / "face.gltf"))
    assert close(rig.deltas[0] / 1000, [[0, 0, 0], [1, 2, 3], [0, 0, 0], [4, 5, 6]])
    assert close(rig.deltas[1] / 1000, [[0, 0, 0], [1, 2, 3], [0, 0, 0.5], [4, 5, 6]])


def test_interleaved_and_normalised_attributes(tmp_path: Path) -> None:
    """Positions of 16 bits and texture coordinates of 8, in one view of 12 bytes a vertex."""
    build = square(["a", "b"])
    rows = np.zeros(4, [("position", "<i2", 4), ("uv", "<u1", 4)])
    rows["position"][:, :3] = np.round(SQUARE * 32767)
    rows["uv"][:, :2] = [[0, 0], [255, 0], [255, 255], [0, 51]]
    view = build.view(rows.tobytes(), byteStride=12)
    shape = {"bufferView": view, "count": 4, "normalized": True}
    attributes = build.root["meshes"][0]["primitives"][0]["attributes"]
    attributes["POSITION"] = build.bare(componentType=5122, type="VEC3", **shape)
    attributes["TEXCOORD_0"] = build.bare(componentType=5121, type="VEC2", byteOffset=8, **shape)
    mesh = load_mesh(build.save(tmp_path / "face.gltf", extensionsRequired=["KHR_mesh_quantization"]))
    assert close(mesh.vertices, SQUARE * 1000)
    corners = mesh.uvs[mesh.uv_faces]
    assert close(corners, [[[0, 1], [1, 1], [1, 0]], [[0, 1], [1, 0], [0, 0.8]]], 1e-6)


def test_texture_coordinates_are_shifted_turned_and_scaled_as_the_material_says(tmp_path: Path) -> None:
    """Whole numbers of gltfpack, brought into the picture by ``KHR_texture_transform``."""
    build = square(["a", "b"])
    primitive = build.root["meshes"][0]["primitives"][0]
    whole = np.array([[0, 0], [4095, 0], [4095, 2047], [0, 2047]], np.uint16)
    primitive["attributes"]["TEXCOORD_1"] = build.accessor(whole)
    change = {"texCoord": 1, "offset": [0.25, 0.5], "scale": [0.5 / 4095, 0.25 / 2047]}
    texture = {"index": 0, "extensions": {"KHR_texture_transform": change}}
    build.root["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": texture}}]
    build.root["textures"] = [{}]
    primitive["material"] = 0
    mesh = load_mesh(build.save(tmp_path / "face.gltf", extensionsRequired=["KHR_texture_transform"]))
    corners = mesh.uvs[mesh.uv_faces]
    assert close(corners[0], [[0.25, 0.5], [0.75, 0.5], [0.75, 0.25]], 1e-6)  # from the lower left
    change["rotation"] = np.pi / 2  # counter-clockwise, as the picture is seen
    mesh = load_mesh(build.save(tmp_path / "face.gltf"))
    corners = mesh.uvs[mesh.uv_faces]
    assert close(corners[0], [[0.25, 0.5], [0.25, 1.0], [0.5, 1.0]], 1e-6)


def test_materials_of_a_character_place_their_textures_on_rows_that_they_share(tmp_path: Path) -> None:
    build = square()
    (first,) = build.root["meshes"][0]["primitives"]
    first["attributes"]["TEXCOORD_0"] = build.accessor(np.array([[0, 0], [100, 0], [1, 1], [0, 1]], np.float32))
    change = {"KHR_texture_transform": {"scale": [0.01, 0.01]}}
    textures = [{"index": 0, "extensions": change}, {"index": 0}]
    build.root["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": texture}} for texture in textures]
    build.root["textures"] = [{}]
    build.root["meshes"][0]["primitives"] = [
        {**first, "material": row, "indices": build.accessor(SQUARE_TRIANGLES.reshape(2, 3)[row].ravel())}
        for row in range(2)
    ]
    character = read_character(read_document(build.save(tmp_path / "face.gltf")))
    assert close(character.uvs[[1, 3]], [[1, 1], [0, 0]], 1e-6)  # each of one of them alone; from the lower left


@pytest.mark.parametrize(("mode", "order"), [(5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
def test_strips_and_fans_face_the_way_triangles_do(mode: int, order: list[int], tmp_path: Path) -> None:
    build = square(["a", "b"])
    primitive = build.root["meshes"][0]["primitives"][0]
    primitive |= {"mode": mode, "indices": build.accessor(np.array(order, np.uint8))}
    mesh = load_mesh(build.save(tmp_path / "face.gltf"))
    corners = mesh.vertices[mesh.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all()
    assert normals[:, 2].sum() == pytest.approx(2e6)


def test_without_nodes_every_mesh_is_read_and_without_a_scene_every_root(tmp_path: Path) -> None:
    build = square(["a", "b"])
    for fields in ({"nodes": [], "scenes": []}, {"scenes": [], "nodes": [{"children": [1]}, {"mesh": 0}]}):
        rig = load_rig(build.save(tmp_path / "face.gltf", **fields))
        assert close(rig.neutral.vertices, SQUARE * 1000)


def test_a_skinned_mesh_stays_where_its_skeleton_holds_it(tmp_path: Path) -> None:
    build = square(["a", "b"])
    build.root |= {"skins": [{"joints": [1]}], "nodes": [{"mesh": 0, "skin": 0, "translation": [9, 9, 9]}, {}]}
    assert close(load_rig(build.save(tmp_path / "face.gltf")).neutral.vertices, SQUARE * 1000)


def test_polygons_stay_out_where_the_triangles_were_edited(tmp_path: Path) -> None:
    build = square(["a", "b"])
    build.root["meshes"][0]["extras"]["torchface"] = {"version": 1, "vertices": 4, "polygons": [[4, 1]]}
    mesh = load_mesh(build.save(tmp_path / "face.gltf"))
    assert mesh.polygons.tolist() == [[0, 1, 2, 3]]
    turned = build.accessor(np.array([0, 1, 2, 2, 3, 0], np.uint16))
    build.root["meshes"][0]["primitives"][0]["indices"] = turned
    mesh = load_mesh(build.save(tmp_path / "face.gltf"))
    assert mesh.polygons is None
    assert mesh.faces.tolist() == [[0, 1, 2], [2, 3, 0]]


def test_points_and_lines_beside_the_face_are_left_out(tmp_path: Path) -> None:
    build = square(["a", "b"])
    build.root["meshes"].append({"primitives": [{"mode": 1, "attributes": {"POSITION": 0}}]})
    build.root["nodes"] = [{"mesh": 1}, {"mesh": 0}]
    build.root["scenes"] = [{"nodes": [0, 1]}]
    assert load_mesh(build.save(tmp_path / "face.gltf")).faces.tolist() == SQUARE_TRIANGLES.reshape(2, 3).tolist()


def test_vertex_colours_are_light_in_the_file_and_coded_in_the_mesh(tmp_path: Path) -> None:
    build = square(["a", "b"])
    light = np.array([[0, 1, 0.2140411, 1]] * 4, np.float32)
    build.root["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = build.accessor(light)
    mesh = load_mesh(build.save(tmp_path / "face.gltf"))
    assert close(mesh.colors, [[0, 1, 0.5]] * 4, 1e-5)
