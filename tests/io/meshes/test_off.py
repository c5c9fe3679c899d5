from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from mutation import check_reader
from rig_samples import quad_sheet

from torchface.errors import FileFormatError
from torchface.io import load_mesh, save_mesh

CUBE_CORNER = """OFF # three squares
7 3 0

0 0 0
1 0 0
1 1 0
0 1 0
0 0 1
1 0 1
0 1 1
4 0 1 2 3  255 0 0
4 0 1 5 4
4 0 3 6 4
"""


def test_a_mesh_comes_back_from_off_with_vertices_and_triangles_in_order(tmp_path: Path) -> None:
    mesh = quad_sheet()
    save_mesh(mesh, tmp_path / "a.off")
    found = load_mesh(tmp_path / "a.off")
    assert torch.allclose(found.vertices, mesh.vertices, rtol=0, atol=1e-9)
    assert torch.equal(found.faces, mesh.faces)
    other = trimesh.load(tmp_path / "a.off", process=False)
    assert np.allclose(other.vertices, mesh.vertices.numpy(), atol=1e-9)


def test_polygons_and_units_of_an_off(tmp_path: Path) -> None:
    (tmp_path / "a.off").write_text(CUBE_CORNER)
    mesh = load_mesh(tmp_path / "a.off", unit="cm")
    assert mesh.vertices[5].tolist() == [10, 0, 10]
    inches, micrometres = (load_mesh(tmp_path / "a.off", unit=unit).vertices[5] for unit in ("in", "um"))
    torch.testing.assert_close(inches, torch.tensor([25.4, 0, 25.4]))
    torch.testing.assert_close(micrometres, torch.tensor([0.001, 0, 0.001]))
    a, b, c = mesh.vertices[mesh.faces].unbind(1)
    assert float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum()) == pytest.approx(600)  # three squares, twice
    (tmp_path / "b.off").write_text(CUBE_CORNER.replace("OFF # three squares\n", "COFF "))
    assert torch.equal(load_mesh(tmp_path / "b.off").faces, mesh.faces)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("OFF", "OGG"), "found no line 'OFF' at its start"),
        (("7 3 0", "7"), "found no counts of vertices and faces"),
        (("7 3 0", "7 0 0"), "found 7 vertices and 0 faces, expected at least one of each"),
        (("7 3 0", "7 4000000000 0"), r"found 10 lines \(truncated\) for 7 vertices and 4000000000 faces"),
        (("7 3 0", "4000000000 3 0"), r"found 10 lines \(truncated\) for 4000000000 vertices and 3 faces"),
        (("4 0 3 6 4\n", ""), r"found 9 lines \(truncated\) for 7 vertices and 3 faces"),
        (("4 0 1 5 4", "4 0 1 5"), "found face 1 as '4 0 1 5', expected at least 3 corners"),
        (("4 0 1 5 4", "2 0 1"), "found face 1 as '2 0 1'"),
        (("4 0 1 5 4", "4 0 1 5 7"), "found no mesh"),
        (("4 0 1 5 4", "4 0 1 5 -1"), "found no mesh"),
        (("1 0 1", "1 0 nan"), "found NaN or infinity in 1 of 7 vertices, first at 5"),
        (("1 0 1", "1 0 x"), "found no mesh"),
        (("1 0 1", "1 0"), "found no mesh"),
    ],
)
def test_what_is_wrong_in_an_off_is_told(change: tuple[str, str], message: str, tmp_path: Path) -> None:
    path = tmp_path / "face.off"
    path.write_text(CUBE_CORNER.replace(*change, 1))
    with pytest.raises(FileFormatError, match=message) as caught:
        load_mesh(path)
    assert str(caught.value).startswith(str(path))


def test_a_mutated_off_is_read_or_refused(tmp_path: Path) -> None:
    save_mesh(quad_sheet(), tmp_path / "sheet.off")
    (tmp_path / "cube.off").write_text(CUBE_CORNER)
    report = check_reader(load_mesh, [tmp_path / "sheet.off", tmp_path / "cube.off"], ".off")
    assert report.read > 0
    assert report.refused > report.cases / 4
