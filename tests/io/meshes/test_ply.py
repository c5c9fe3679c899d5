from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from mutation import check_reader
from rig_samples import quad_sheet, rigs

from torchface import BlendshapeRig, Mesh, TorchfaceError, load_mesh, save_mesh
from torchface.errors import FileFormatError, TopologyError

ASCII_PLY = """ply
format ascii 1.0
comment by hand
element vertex 4
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
property float s
property float t
element face 2
property list uchar int vertex_indices
property int group
end_header
0 0 0 255 0 0 0 0
1 0 0 0 255 0 1 0
1 1 0 0 0 255 1 1
0 1 0 51 51 51 0 1
4 0 1 2 3 7
3 0 1 2 8
"""
ASCII_STL = """solid a
 facet normal 0 0 1
  outer loop
   vertex 0 0 0
   vertex 1 0 0
   vertex 1 1 0
  endloop
 endfacet
 facet normal 0 0 1
  outer loop
   vertex -0 0 0
   vertex 1 1 0
   vertex 0 1 0
  endloop
 endfacet
endsolid a
"""


@settings(max_examples=25)
@given(rig=rigs())
def test_any_mesh_comes_back_from_ply(rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "any.ply"
    mesh = rig.neutral
    save_mesh(mesh, path)
    found = load_mesh(path)
    assert torch.equal(found.vertices, mesh.vertices)
    assert torch.equal(found.faces, mesh.faces)
    if mesh.polygons.shape[1] > 3:
        assert torch.equal(found.polygons, mesh.polygons)
    if mesh.colors is not None:
        assert (found.colors - mesh.colors).abs().max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_what_trimesh_writes_as_ply_is_read(encoding: str, tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    sphere.visual.vertex_colors = np.random.default_rng(0).integers(0, 255, (len(sphere.vertices), 4), dtype=np.uint8)
    (tmp_path / "a.ply").write_bytes(sphere.export(file_type="ply", encoding=encoding))
    mesh = load_mesh(tmp_path / "a.ply", unit="cm")
    assert np.allclose(mesh.vertices.numpy(), sphere.vertices * 10, atol=1e-5)
    assert np.array_equal(mesh.faces.numpy(), sphere.faces)
    assert np.allclose(mesh.colors.numpy() * 255, sphere.visual.vertex_colors[:, :3], atol=1e-3)


def test_trimesh_reads_what_we_write(tmp_path: Path) -> None:
    mesh = quad_sheet()
    triangles = Mesh(mesh.vertices, mesh.faces, colors=mesh.colors)
    save_mesh(triangles, tmp_path / "a.ply")
    save_mesh(triangles, tmp_path / "a.stl")
    for name in ("a.ply", "a.stl"):
        other = trimesh.load(tmp_path / name, process=False)
        assert np.allclose(other.vertices[other.faces], mesh.vertices[mesh.faces].numpy(), atol=1e-5)
    assert np.allclose(other.face_normals[:, 2] > 0, True)


def test_polygons_colours_and_coordinates_of_an_ascii_ply(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(ASCII_PLY)
    mesh = load_mesh(tmp_path / "a.ply")
    assert mesh.polygons.tolist() == [[0, 1, 2, 3], [0, 1, 2, -1]]
    assert mesh.uvs[3].tolist() == [0, 1]
    assert torch.allclose(mesh.colors[3], torch.full((3,), 0.2))


def test_big_endian_is_turned_round(tmp_path: Path) -> None:
    header = "ply\nformat binary_big_endian 1.0\nelement vertex 3\nproperty double x\nproperty double y\n"
    header += "property double z\nelement face 1\nproperty list uint uint vertex_index\nend_header\n"
    data = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0]], ">f8").tobytes() + np.array([3, 2, 1, 0], ">u4").tobytes()
    (tmp_path / "a.ply").write_bytes(header.encode() + data)
    mesh = load_mesh(tmp_path / "a.ply")
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 2, 0]]
    assert mesh.faces.tolist() == [[2, 1, 0]]


def test_stl_corners_weld_in_order_of_appearance(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_text(ASCII_STL)
    mesh = load_mesh(tmp_path / "a.stl")
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    save_mesh(mesh, tmp_path / "b.stl")
    again = load_mesh(tmp_path / "b.stl")
    assert torch.equal(again.vertices, mesh.vertices)
    assert torch.equal(again.faces, mesh.faces)


@pytest.mark.parametrize(
    ("change", "kind", "message"),
    [
        (("ply\n", "plx\n"), FileFormatError, "found no PLY header"),
        (("end_header\n", "end\n"), FileFormatError, "found no PLY header"),
        (("ascii", "ebcdic"), FileFormatError, "found no format that is known, expected one of binary_little_endian"),
        (
            ("vertex 4", "vertex 4000000000"),
            FileFormatError,
            r"found 43 bytes or words \(truncated\) for 40+ rows",
        ),
        (("face 2", "face 0"), FileFormatError, "found 4 vertices and no face"),
        (("face 2", "face 3"), FileFormatError, r"\(truncated\) for 3 rows of 'face'"),
        (("property float x\n", ""), FileFormatError, "found no vertices with x, y and z|text|truncated"),
        (("4 0 1 2 3 7", "2 0 1 7"), FileFormatError, "found a face of 2 corners, expected at least 3"),
        (("4 0 1 2 3 7", "4 0 1 2 9 7"), TopologyError, "found faces with vertex 0 to 9, expected 0 to 3"),
        (("4 0 1 2 3 7", "9999 0 1 2 3 7"), FileFormatError, "expected a list of 9999"),
        (("0 1 0 51", "0 nan 0 51"), FileFormatError, "found NaN or infinity in 1 of 4 vertices, first at 3"),
        (("0 1 0 51", "0 one 0 51"), FileFormatError, "found text among the numbers"),
        (("property float x", "property quad x"), FileFormatError, "found the header line 'property quad x'"),
        (("property float y", "property float x"), FileFormatError, "expected some, each once"),
    ],
)
def test_what_is_wrong_in_a_ply_is_told(
    change: tuple[str, str], kind: type[TorchfaceError], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "face.ply"
    path.write_text(ASCII_PLY.replace(*change, 1))
    with pytest.raises(kind, match=message) as caught:
        load_mesh(path)
    assert str(caught.value).startswith(str(path))


def test_what_is_wrong_in_an_stl_is_told(tmp_path: Path) -> None:
    save_mesh(quad_sheet(), tmp_path / "good.stl")
    data = (tmp_path / "good.stl").read_bytes()
    for content, message in (
        (data[:-1], r"found \d+ bytes for 40 triangles \(truncated, or no STL\), expected 2084"),
        (data[:80] + b"\xff\xff\xff\xff" + data[84:], "bytes for 4294967295 triangles"),
        (bytes(84), "found no triangle"),
        (ASCII_STL.replace("vertex 1 1 0", "vertex 1 b 0").encode(), "found text in a vertex line"),
        (
            ASCII_STL.replace("vertex 1 1 0", "", 1).encode(),
            r"found 5 corners \(truncated\), expected three a triangle",
        ),
        (ASCII_STL.replace("vertex 1 1 0", "vertex inf 1 0").encode(), "found NaN or infinity in 2 of 6 vertices"),
    ):
        (tmp_path / "bad.stl").write_bytes(content)
        with pytest.raises(FileFormatError, match=message):
            load_mesh(tmp_path / "bad.stl")


def test_a_mutated_ply_is_read_or_refused(tmp_path: Path) -> None:
    save_mesh(quad_sheet(), tmp_path / "mixed.ply")
    triangles = Mesh(quad_sheet().vertices, quad_sheet().faces)
    save_mesh(triangles, tmp_path / "triangles.ply")
    (tmp_path / "ascii.ply").write_text(ASCII_PLY)
    seeds = [tmp_path / name for name in ("mixed.ply", "triangles.ply", "ascii.ply")]
    report = check_reader(load_mesh, seeds, ".ply")
    assert report.read > 0
    assert report.refused > report.cases / 4


def test_a_mutated_stl_is_read_or_refused(tmp_path: Path) -> None:
    save_mesh(quad_sheet(), tmp_path / "binary.stl")
    (tmp_path / "ascii.stl").write_text(ASCII_STL)
    report = check_reader(load_mesh, [tmp_path / "binary.stl", tmp_path / "ascii.stl"], ".stl")
    assert report.read > 0
    assert report.refused > report.cases / 5
