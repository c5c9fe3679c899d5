from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from mutation import check_reader
from rig_samples import quad_sheet, rigs
from torch import Tensor

from torchface.errors import FileFormatError, TopologyError, TorchfaceError
from torchface.io import load_mesh, save_image, save_mesh
from torchface.rig import BlendshapeRig

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@settings(max_examples=25)
@given(rig=rigs())
def test_any_mesh_comes_back_exactly(rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "any.obj"
    mesh = rig.neutral
    save_mesh(mesh, path)
    found = load_mesh(path)
    assert torch.equal(found.vertices, mesh.vertices)
    assert torch.equal(found.faces, mesh.faces)
    if mesh.polygons.shape[1] > 3:
        assert torch.equal(found.polygons, mesh.polygons)
    assert (found.uvs is None) == (mesh.uvs is None)
    if mesh.uvs is not None:
        assert torch.equal(found.uvs, mesh.uvs)
        assert torch.equal(found.uv_faces, mesh.uv_faces)
    assert (found.colors is None) == (mesh.colors is None)
    if mesh.colors is not None:
        assert torch.allclose(found.colors, mesh.colors, atol=1e-7)


def test_the_texture_goes_beside_the_file_and_comes_back(tmp_path: Path) -> None:
    mesh = quad_sheet()
    save_mesh(mesh, tmp_path / "sheet.obj")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sheet.mtl", "sheet.obj", "sheet.png"]
    found = load_mesh(tmp_path / "sheet.obj")
    assert (found.texture - mesh.texture).abs().max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize("scene", ["sheet.obj", "sheet.usdc"])
def test_a_picture_of_the_users_beside_the_file_is_kept_each_time(scene: str, tmp_path: Path) -> None:
    mesh, picture = quad_sheet(), tmp_path / "sheet.png"
    darker = replace(mesh, texture=mesh.texture / 2)

    def shown() -> Tensor:
        return load_mesh(tmp_path / scene).texture

    save_mesh(replace(mesh, texture=None), tmp_path / scene)
    picture.write_bytes(b"the user's")
    for _ in range(2):  # the second time a file of torchface's is there too
        with pytest.warns(UserWarning, match=rf"sheet.png beside it.*it is kept, and {scene} takes sheet_2.png"):
            save_mesh(mesh, tmp_path / scene)
        assert picture.read_bytes() == b"the user's"
        assert (shown() - mesh.texture).abs().max() <= 0.5 / 255 + 1e-6
    picture.unlink()
    save_mesh(mesh, tmp_path / scene)
    save_mesh(darker, tmp_path / scene)  # its own is replaced
    assert (shown() - darker.texture).abs().max() <= 0.5 / 255 + 1e-6
    save_image(torch.zeros(3, 4, 4), picture)  # painted over by the user
    painted = picture.read_bytes()
    with pytest.warns(UserWarning, match="changed since"):
        save_mesh(mesh, tmp_path / scene)
    assert picture.read_bytes() == painted


def test_two_scenes_share_a_picture_that_is_alike_and_no_other(tmp_path: Path) -> None:
    mesh = quad_sheet()
    save_mesh(mesh, tmp_path / "sheet.obj")
    save_mesh(mesh, tmp_path / "sheet.usdc")
    assert sorted(path.name for path in tmp_path.glob("*.png")) == ["sheet.png"]
    with pytest.warns(UserWarning, match="takes sheet_2.png"):
        save_mesh(replace(mesh, texture=mesh.texture / 2), tmp_path / "sheet.usdc")
    found = load_mesh(tmp_path / "sheet.obj").texture
    assert (found - mesh.texture).abs().max() <= 0.5 / 255 + 1e-6


@pytest.mark.real
def test_a_real_scan_reads_as_trimesh_reads_it(data: Path) -> None:
    for path in sorted((data / "scans").rglob("*.obj")):
        ours = load_mesh(path)
        theirs = trimesh.load(path, process=False, force="mesh")
        a = ours.vertices[ours.faces].double().numpy()
        b = theirs.vertices[theirs.faces]
        assert a.shape == b.shape
        assert np.abs(a - b).max() < 1e-3
        if ours.uvs is not None and theirs.visual.uv is not None:
            difference = ours.uvs[ours.uv_faces].double().numpy() - theirs.visual.uv[theirs.faces]
            assert np.abs(difference).max() < 1e-5


def test_corners_may_be_written_in_any_of_the_known_ways(tmp_path: Path) -> None:
    coordinates = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\n"
    plain = load_mesh(write(tmp_path / "a.obj", SQUARE + "f 1 2 3 4\n"))
    assert plain.uvs is None
    assert plain.polygons.tolist() == [[0, 1, 2, 3]]
    for face in ("1/1 2/2 3/3 4/4", "1/1/1 2/2/1 3/3/1 4/4/1", "-4/-4 -3/-3 -2/-2 -1/-1", "1/1 \\\n 2/2 3/3 4/4"):
        mesh = load_mesh(write(tmp_path / "a.obj", "# a comment\r\n" + SQUARE + coordinates + f"s off\nf {face}\n"))
        assert mesh.polygons.tolist() == [[0, 1, 2, 3]]
        assert mesh.uvs[mesh.uv_faces].tolist() == [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]]
    normals_only = load_mesh(write(tmp_path / "a.obj", SQUARE + "vn 0 0 1\nf 1//1 2//1 3//1\n"))
    assert normals_only.uvs is None
    assert normals_only.polygons is None


def test_relative_corners_count_from_where_they_stand(tmp_path: Path) -> None:
    text = SQUARE + "f -4 -3 -2\n" + "v 5 5 5\nv 6 5 5\nv 6 6 5\n" + "f -3 -2 -1\n"
    assert load_mesh(write(tmp_path / "a.obj", text)).faces.tolist() == [[0, 1, 2], [4, 5, 6]]


def test_units_become_millimetres_and_colours_fractions(tmp_path: Path) -> None:
    path = write(tmp_path / "a.obj", "v 1 2 3 255 0 51\nv 0 0 0 0 0 0\nv 1 0 0 0 0 0\nf 1 2 3\n")
    for unit, factor in (("mm", 1), ("cm", 10), ("m", 1000)):
        assert load_mesh(path, unit=unit).vertices[0].tolist() == [factor, 2 * factor, 3 * factor]
    assert torch.allclose(load_mesh(path).colors[0], torch.tensor([1, 0, 0.2]))


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        (SQUARE, FileFormatError, r"found 4 vertices and no face \(line 'f'\), expected at least one face"),
        ("f 1 2 3\n", FileFormatError, r"found no vertex \(line 'v x y z'\)"),
        (SQUARE + "f 1 2\n", FileFormatError, "found 2 corners in face 0, expected at least 3"),
        (SQUARE + "f 1 2 9\n", TopologyError, "found faces with vertex 1 to 9, expected 1 to 4"),
        (SQUARE + "f 0 1 2\n", TopologyError, "found faces with vertex 0 to 2, expected 1 to 4"),
        (SQUARE + "f -9 1 2\n", TopologyError, "found faces with vertex -4 to 2, expected 1 to 4"),
        (SQUARE + "f 1 2 a\n", FileFormatError, "found text in an 'f' line, expected integers"),
        (SQUARE + "f 1 2 3.5\n", FileFormatError, "found text in an 'f' line, expected integers"),
        (SQUARE + f"f 1 2 {10**30}\n", TopologyError, "found an index of more than 63 bits"),
        (SQUARE + "vt 0 0\nf 1/1 2/1 3/7\n", TopologyError, "texture coordinate 1 to 7, expected 1 to 1"),
        ("v 0 0\n" + SQUARE + "f 1 2 3\n", FileFormatError, "found 2 numbers in 'v' line 1, expected 3 or 4 or 6"),
        (SQUARE + "v 0 0 0 1\nf 1 2 3\n", FileFormatError, "found 4 numbers in 'v' line 5, expected .* the same"),
        (SQUARE + "v 1 x 2\nf 1 2 3\n", FileFormatError, "found text in a 'v' line, expected numbers"),
        (SQUARE + "v 1 nan 2\nf 1 2 3\n", FileFormatError, "found NaN or infinity in 1 of 5 vertices, first at 4"),
        (SQUARE + "v 1 1e300 2\nf 1 2 3\n", FileFormatError, "found NaN or infinity in 1 of 5 vertices"),
        ("\0\1\2" * 50, FileFormatError, "found binary data, expected the text of an OBJ"),
        ("", FileFormatError, "found an empty file"),
        (SQUARE + "f 1 2 3\n" * 9000 + "f" + " 1" * 9000 + "\n", FileFormatError, "found a polygon of 9000 corners"),
    ],
)
def test_what_is_wrong_is_told(text: str, kind: type[TorchfaceError], message: str, tmp_path: Path) -> None:
    path = write(tmp_path / "face.obj", text)
    with pytest.raises(kind, match=message) as caught:
        load_mesh(path)
    assert str(caught.value).startswith(str(path))


def test_a_missing_file_and_a_folder_are_told(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"none.obj: found no such file"):
        load_mesh(tmp_path / "none.obj")
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(FileFormatError, match=r"folder.obj: found a folder or a device"):
        load_mesh(tmp_path / "folder.obj")


def test_materials_lead_nowhere_outside_the_folder(tmp_path: Path) -> None:
    save_image(torch.ones(3, 2, 2), tmp_path / "secret.png")
    (tmp_path / "inside").mkdir()
    text = "mtllib a.mtl\n" + SQUARE + "vt 0 0\nusemtl skin\nf 1/1 2/1 3/1\n"
    for picture in ("../secret.png", str(tmp_path / "secret.png"), "missing.png", "x" * 3000):
        (tmp_path / "inside" / "a.mtl").write_text(f"newmtl skin\nmap_Kd {picture}\n")
        assert load_mesh(write(tmp_path / "inside" / "a.obj", text)).texture is None
    save_image(torch.ones(3, 2, 2), tmp_path / "inside" / "own.png")
    (tmp_path / "inside" / "a.mtl").write_text("newmtl skin\nmap_Kd own.png\n")
    assert load_mesh(tmp_path / "inside" / "a.obj").texture.shape == (3, 2, 2)
    (tmp_path / "inside" / "own.png").write_bytes(b"no picture")
    with pytest.raises(FileFormatError, match=r"own.png: no readable image"):
        load_mesh(tmp_path / "inside" / "a.obj")


def test_faces_have_the_images_and_colours_of_their_own_materials(tmp_path: Path) -> None:
    """Also a material that no library has, which looks like the first image, and a face before any material."""
    for name, color in (("red", (1.0, 0.0, 0.0)), ("blue", (0.0, 0.0, 1.0))):
        save_image(torch.tensor(color).view(3, 1, 1).expand(3, 8, 8), tmp_path / f"{name}.png")
    (tmp_path / "a.mtl").write_text(
        "newmtl r\nKd 0 0 0\nmap_Kd red.png\nnewmtl b\nmap_Kd blue.png\nnewmtl g\nKd 0 1 0\n"
    )
    square, face = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n", "f 1/1 2/2 3/3 4/4\n"
    used = (
        "usemtl r\n" + face + "usemtl b\n" + 2 * face + "usemtl g\nf 1 2 3\nusemtl lost\n" + face + "usemtl b\n" + face
    )
    mesh = load_mesh(write(tmp_path / "a.obj", "mtllib a.mtl\n" + square + face + used))
    middle = mesh.uvs[mesh.uv_faces].mean(1)
    height, width = mesh.texture.shape[1:]
    column, row = (middle[:, 0] * width).long(), ((1 - middle[:, 1]) * height).long()
    seen = mesh.texture[:, row, column].T
    expected = "rr rr bb bb g rr bb".replace(" ", "")
    assert seen.tolist() == [{"r": [1, 0, 0], "b": [0, 0, 1], "g": [0, 1, 0]}[one] for one in expected]


def test_a_mutated_obj_is_read_or_refused(tmp_path: Path) -> None:
    mesh = quad_sheet()
    save_mesh(mesh, tmp_path / "sheet.obj")
    write(tmp_path / "odd.obj", SQUARE + "vt 0 0\nvn 0 0 1\nf -4/-1/1 -3/-1/1 -2/-1/1\nf 1//1 2//1 3//1 4//1\n")
    report = check_reader(load_mesh, [tmp_path / "sheet.obj", tmp_path / "odd.obj"], ".obj")
    assert report.read > 0
    assert report.refused > report.cases / 4


def test_a_long_line_that_nobody_reads_is_left_out(tmp_path: Path) -> None:
    polyline = "l " + "1 2 3 4 " * 150_000
    path = write(tmp_path / "a.obj", f"{SQUARE}{polyline}\nf 1 2 3 4\n# {'x' * 2**20}")
    assert load_mesh(path).polygons.tolist() == [[0, 1, 2, 3]]
