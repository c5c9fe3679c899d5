"""OFF: a list of vertices, then of faces, as text; written through trimesh."""

from array import array
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from torchface.errors import FileFormatError
from torchface.files.line_pieces import line_pieces
from torchface.files.whole_files import read_file, write_file
from torchface.io.length_units import finite_vertices, millimetres_per
from torchface.io.meshes.polygons import pad_polygons
from torchface.mesh import Mesh, fan_triangulation

_HEADS = (b"OFF", b"COFF", b"NOFF", b"CNOFF", b"STOFF")


def read_off(path: str | Path, unit: str = "mm") -> Mesh:
    """The mesh in an OFF file of ``mm``, ``cm`` or ``m``, its vertices in order; polygons are cut, colours left out."""
    path, scale = Path(path), millimetres_per(unit)
    lines = _filled_lines(path, read_file(path))
    vertex_count, face_count = _counts(path, lines)
    coordinates, sizes, corners = array("d"), array("q"), array("q")
    count = 0
    try:
        for words in islice(lines, vertex_count):  # text comes by the line
            coordinates.extend(map(float, words[:3]))
            count += 1
        for number, words in enumerate(islice(lines, face_count)):  # each face says for itself how many corners it has
            if not words[0].isdigit() or not 3 <= int(words[0][:9]) < len(words):
                raise FileFormatError(
                    f"{path}: found face {number} as '{b' '.join(words)[:60].decode('latin-1')}', "
                    "expected at least 3 corners, their count before them"
                )
            sizes.append(int(words[0]))
            corners.extend(map(int, words[1 : sizes[-1] + 1]))
            count += 1
    except (ValueError, OverflowError) as error:
        raise FileFormatError(f"{path}: found no mesh ({str(error)[:200]}), expected an OFF file") from error
    if count < vertex_count + face_count:
        raise FileFormatError(
            f"{path}: found {count} lines (truncated) for {vertex_count} vertices and {face_count} faces, "
            f"expected {vertex_count + face_count}"
        )
    if len(coordinates) != 3 * vertex_count:
        raise FileFormatError(
            f"{path}: found no mesh ({len(coordinates)} coordinates of {vertex_count} vertices), expected an OFF file"
        )
    table, ids = np.frombuffer(coordinates).reshape(-1, 3), np.frombuffer(corners, np.int64)
    if ids.min() < 0 or ids.max() >= vertex_count:
        raise FileFormatError(
            f"{path}: found no mesh (faces with vertex {ids.min()} to {ids.max()} of {vertex_count}), "
            "expected an OFF file"
        )
    polygons = pad_polygons(str(path), np.frombuffer(sizes, np.int64), ids)
    faces = polygons if polygons.shape[1] == 3 else fan_triangulation(polygons)
    return Mesh(finite_vertices(path, table * scale), faces)


def write_off(mesh: Mesh, path: str | Path) -> None:
    """Writes vertices in the mesh's order and triangles, in millimetres."""
    from trimesh import Trimesh
    from trimesh.exchange.off import export_off

    plain = Trimesh(mesh.vertices.detach().cpu().double().numpy(), mesh.faces.cpu().numpy(), process=False)
    write_file(path, export_off(plain).encode())


def _filled_lines(path: Path, data: bytes) -> Iterator[list[bytes]]:
    """The words of every line that has some, without comments."""
    for piece in line_pieces(path, data):
        for line in piece.splitlines():
            if words := line.partition(b"#")[0].split():
                yield words


def _counts(path: Path, lines: Iterator[list[bytes]]) -> tuple[int, int]:
    """How many vertices and faces the head announces."""
    first = next(lines, [])
    if not first or first[0] not in _HEADS:
        raise FileFormatError(f"{path}: found no line 'OFF' at its start, expected an OFF mesh")
    counts = (first[1:] or next(lines, []))[:2]
    if len(counts) < 2 or not all(word.isdigit() and len(word) < 16 for word in counts):
        raise FileFormatError(f"{path}: found no counts of vertices and faces, expected them behind 'OFF'")
    vertices, faces = map(int, counts)
    if vertices == 0 or faces == 0:
        raise FileFormatError(f"{path}: found {vertices} vertices and {faces} faces, expected at least one of each")
    return vertices, faces
