"""OFF through trimesh, behind checks: a list of vertices, then of faces, as text."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import torch

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file, write_file
from torchface.io.length_units import finite_vertices, millimetres_per
from torchface.mesh import Mesh

_HEADS = (b"OFF", b"COFF", b"NOFF", b"CNOFF", b"STOFF")


def read_off(path: str | Path, unit: str = "mm") -> Mesh:
    """The mesh in an OFF file: vertices in the file's order, triangles; polygons are cut, colours left out.

    Args:
        path: the file.
        unit: the file's unit, ``"mm"``, ``"cm"`` or ``"m"``.

    Raises:
        FileFormatError: not an OFF, truncated, without faces, a face names a vertex that is not there, or NaN.
    """
    from trimesh.exchange.off import load_off  # takes a while to import

    path, scale = Path(path), millimetres_per(unit)
    data = read_file(path)
    _check_counts(path, data)
    try:
        found = load_off(BytesIO(data))
        vertices, faces = np.asarray(found["vertices"], np.float64), np.asarray(found["faces"], np.int64)
        if faces.min() < 0 or faces.max() >= len(vertices):  # early versions of trimesh let it pass
            raise IndexError(f"faces with vertex {faces.min()} to {faces.max()} of {len(vertices)}")
    except (ValueError, IndexError, OverflowError, TypeError) as error:
        raise FileFormatError(f"{path}: found no mesh ({str(error)[:200]}), expected an OFF file") from error
    return Mesh(finite_vertices(path, vertices * scale), torch.from_numpy(np.ascontiguousarray(faces)))


def write_off(mesh: Mesh, path: str | Path) -> None:
    """Writes vertices in the mesh's order and triangles, in millimetres.

    Raises:
        FileFormatError: the folder cannot be written to.
    """
    from trimesh import Trimesh
    from trimesh.exchange.off import export_off

    plain = Trimesh(mesh.vertices.detach().cpu().double().numpy(), mesh.faces.cpu().numpy(), process=False)
    write_file(path, export_off(plain).encode())


def _check_counts(path: Path, data: bytes) -> None:
    """Refuses what trimesh would read in part: fewer lines than are promised, or faces of fewer corners."""
    lines = [words for line in data.splitlines() if (words := line.partition(b"#")[0].split())]
    head = lines[0][0] if lines else b""
    if head not in _HEADS:
        raise FileFormatError(f"{path}: found no line 'OFF' at its start, expected an OFF mesh")
    rest = [lines[0][1:], *lines[1:]] if len(lines[0]) > 1 else lines[1:]
    counts = rest[0][:2] if rest else []
    if len(counts) < 2 or not all(word.isdigit() and len(word) < 16 for word in counts):
        raise FileFormatError(f"{path}: found no counts of vertices and faces, expected them behind 'OFF'")
    vertices, faces = map(int, counts)
    if vertices == 0 or faces == 0:
        raise FileFormatError(f"{path}: found {vertices} vertices and {faces} faces, expected at least one of each")
    rows = rest[1 + vertices : 1 + vertices + faces]
    if len(rows) < faces:
        raise FileFormatError(
            f"{path}: found {len(rest) - 1} lines (truncated) for {vertices} vertices and {faces} faces, "
            f"expected {vertices + faces}"
        )
    for number, row in enumerate(rows):  # each face says for itself how many corners it has
        if not row[0].isdigit() or not 3 <= int(row[0][:9]) < len(row):
            raise FileFormatError(
                f"{path}: found face {number} as '{b' '.join(row)[:60].decode('latin-1')}', "
                "expected at least 3 corners, their count before them"
            )
