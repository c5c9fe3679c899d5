"""Statements of an OBJ as arrays: read piece by piece, since words take far more memory than their text."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchface.errors import FileFormatError, TopologyError
from torchface.files.line_pieces import line_pieces
from torchface.io.meshes.polygons import MESHING

_VERTEX_WIDTHS = (3, 4, 6, 7)
_MAX_LIBRARIES = 64


@dataclass
class Statements:
    """What an OBJ says."""

    vertices: NDArray[np.float64]  # numbers of each vertex, (V,3) and more
    coordinates: list[bytes]  # lines of texture coordinates, which stay text until a face needs them, in pieces
    sizes: NDArray[np.int64]  # corners of each face, (P,)
    corners: NDArray[np.int64]  # vertex ids, (C,)
    uv_corners: NDArray[np.int64] | None  # which texture coordinate, (C,), -1 for none; absent where no corner has one
    libraries: list[bytes]  # material files in their order, each once
    materials: list[tuple[bytes, int]]  # in use, and how many faces come before each, in their order


def read_statements(path: Path, data: bytes) -> Statements:
    """What is read of an OBJ."""
    vertices, faces = [], []
    coordinates: list[bytes] = []
    coordinate_count = 0
    libraries: dict[bytes, None] = {}
    materials: list[tuple[bytes, int]] = []
    face_count = 0
    for lines in _lines_by_keyword(path, data):
        vertices.append(_number_rows(path, "v", lines[b"v"], _VERTEX_WIDTHS))
        faces.append(_face_corners(path, lines[b"f"]))
        coordinates.append(b"\n".join(lines[b"vt"]))
        coordinate_count += len(lines[b"vt"])
        libraries.update(dict.fromkeys(lines[b"mtllib"]))
        for line in lines[b"usemtl"]:
            above, name = line.split(b" ", 1)
            if not materials or materials[-1][0] != name:
                materials.append((name, face_count + int(above)))
        face_count += len(lines[b"f"])
        if len(libraries) > _MAX_LIBRARIES:
            raise FileFormatError(f"{path}: found more than {_MAX_LIBRARIES} material files, expected fewer")
    table = _joined(path, vertices)
    if not len(table):
        raise FileFormatError(f"{path}: found no vertex (line 'v x y z'), expected an OBJ mesh")
    sizes = np.concatenate([piece.sizes for piece in faces])
    if not len(sizes):
        raise FileFormatError(
            f"{path}: found {len(table)} vertices and no face (line 'f'), expected at least one face; {MESHING}"
        )
    if sizes.min() < 3:
        raise FileFormatError(
            f"{path}: found {int(sizes.min())} corners in face {int(sizes.argmin())}, expected at least 3"
        )
    corners = np.concatenate([piece.corners for piece in faces])
    _check_range(path, "vertex", corners, len(table))
    uv_corners = None
    if coordinate_count and any(piece.uv_corners is not None for piece in faces):
        uv_corners = np.concatenate(
            [np.full(len(p.corners), -1) if p.uv_corners is None else p.uv_corners for p in faces]
        )
        if uv_corners.max() < 0:
            uv_corners = None
        else:
            _check_range(path, "texture coordinate", uv_corners, coordinate_count, first=-1)
    return Statements(table, coordinates, sizes, corners, uv_corners, list(libraries), materials)


def read_vertices(path: Path, data: bytes) -> NDArray[np.float64]:
    """The numbers of each vertex alone, (V,3) and more."""
    table = _plain_vertices(path, data)
    if table is not None:
        return table
    return _joined(
        path, [_number_rows(path, "v", lines[b"v"], _VERTEX_WIDTHS) for lines in _lines_by_keyword(path, data)]
    )


def texture_coordinates(path: Path, lines: Iterable[bytes]) -> NDArray[np.float32]:
    """The texture coordinates (T,2) that the lines of ``Statements`` say."""
    tables = []
    for piece in lines:
        rows = [b" ".join(line.split()[:2]) for line in piece.split(b"\n")] if piece else []
        tables.append(_number_rows(path, "vt", rows, (2,)).astype(np.float32))
    uvs = np.concatenate(tables)
    if not np.isfinite(uvs).all():
        raise FileFormatError(f"{path}: found NaN or infinity among the texture coordinates, expected finite numbers")
    return uvs


def _plain_vertices(path: Path, data: bytes) -> NDArray[np.float64] | None:
    """The vertices of a file whose first to last vertex line hold nothing but ``v x y z``; none of another file.

    A piece is split at once; every fourth word being the keyword, and a line a vertex, says that no line is odd.
    """
    start = 0 if data.startswith(b"v ") else data.find(b"\nv ") + 1
    last = data.rfind(b"\nv ") + 1
    end = data.find(b"\n", last)
    tables = []
    for piece in line_pieces(path, data, start, end if end >= 0 else None):
        block = piece.strip()
        words = block.split()
        count = len(words) // 4
        if not count or len(words) % 4 or words[::4].count(b"v") != count or block.count(b"\n") != count - 1:
            return None
        del words[::4]
        tables.append(_floats(path, "v", words).reshape(count, 3))
    return np.concatenate(tables) if tables else None


def _floats(path: Path, keyword: str, words: Iterable[bytes]) -> NDArray[np.float64]:
    try:
        return np.array(list(map(float, words)), dtype=np.float64)
    except ValueError as error:
        raise FileFormatError(f"{path}: found text in a '{keyword}' line, expected numbers ({error})") from error


def _lines_by_keyword(path: Path, data: bytes) -> Iterator[dict[bytes, list[bytes]]]:
    """What follows the keyword, for the keywords that are read, piece by piece; text comes by the line.

    Before the name of a material stands how many of the piece's faces come before it.
    """
    if b"\0" in data[:4096]:
        raise FileFormatError(f"{path}: found binary data, expected the text of an OBJ")
    vertex_count = coordinate_count = 0
    joined = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    for piece in line_pieces(path, joined, unread=(b"l ", b"p ", b"#")):
        known: dict[bytes, list[bytes]] = {b"v": [], b"vt": [], b"f": [], b"mtllib": [], b"usemtl": []}
        vertices, coordinates, faces = known[b"v"], known[b"vt"], known[b"f"]
        for line in piece.splitlines():
            words = line.split(None, 1)
            if len(words) == 2 and (rows := known.get(words[0])) is not None:
                is_material = words[0] == b"usemtl"
                rows.append(b"%d %b" % (len(faces), words[1]) if is_material else words[1])
                if rows is faces and b"-" in words[1]:  # a relative index counts back from the last vertex above it
                    above = vertex_count + len(vertices), coordinate_count + len(coordinates)
                    faces[-1] = _absolute(path, words[1], *above)
        vertex_count += len(vertices)
        coordinate_count += len(coordinates)
        yield known


def _absolute(path: Path, face: bytes, vertices: int, coordinates: int) -> bytes:
    """A face with its negative indices counted from the start."""
    corners = []
    for corner in face.split():
        parts = corner.split(b"/")
        for index, count in ((0, vertices), (1, coordinates)):
            if len(parts) > index and parts[index].startswith(b"-"):
                parts[index] = b"%d" % (count + 1 + _integers(path, [parts[index]])[0])
        corners.append(b"/".join(parts))
    return b" ".join(corners)


def _joined(path: Path, tables: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """The vertices of all pieces; a piece may have none."""
    filled = [table for table in tables if len(table)]
    widths = sorted({table.shape[1] for table in filled})
    if len(widths) > 1:
        raise FileFormatError(f"{path}: found {widths} numbers in 'v' lines, expected in every line the same")
    return np.concatenate(filled) if filled else np.zeros((0, 3))


def _number_rows(path: Path, keyword: str, lines: Sequence[bytes], widths: Sequence[int]) -> NDArray[np.float64]:
    rows = [line.split() for line in lines]
    widths_there = set(map(len, rows))
    if len(widths_there) > 1 or not widths_there <= set(widths):
        odd = next(i for i, row in enumerate(rows) if len(row) not in widths or len(row) != len(rows[0]))
        raise FileFormatError(
            f"{path}: found {len(rows[odd])} numbers in '{keyword}' line {odd + 1}, "
            f"expected {' or '.join(map(str, widths))}, in every line the same"
        )
    numbers = _floats(path, keyword, chain.from_iterable(rows))
    return numbers.reshape(len(rows), -1) if rows else numbers.reshape(0, widths[0])


def _integers(path: Path, words: Sequence[bytes]) -> list[int]:
    try:
        return list(map(int, words))
    except ValueError as error:
        raise FileFormatError(f"{path}: found text in an 'f' line, expected integers ({error})") from error


def _index_array(path: Path, words: Sequence[bytes]) -> NDArray[np.int64]:
    try:
        return np.array(_integers(path, words), dtype=np.int64) - 1
    except OverflowError as error:
        raise TopologyError(f"{path}: found an index of more than 63 bits in an 'f' line") from error


@dataclass(frozen=True)
class _Faces:
    """Faces of one piece; see ``Statements``."""

    sizes: NDArray[np.int64]
    corners: NDArray[np.int64]
    uv_corners: NDArray[np.int64] | None


def _face_corners(path: Path, lines: Sequence[bytes]) -> _Faces:
    rows = [line.split() for line in lines]
    sizes = np.fromiter(map(len, rows), dtype=np.int64, count=len(rows))
    words = list(chain.from_iterable(rows))
    del rows
    if not any(b"/" in line for line in lines):
        return _Faces(sizes, _index_array(path, words), None)
    parts = [word.split(b"/", 2) for word in words]
    corners = _index_array(path, [part[0] for part in parts])
    if all(len(part) < 2 or not part[1] for part in parts):
        return _Faces(sizes, corners, None)
    uv_corners = _index_array(path, [part[1] if len(part) > 1 and part[1] else b"0" for part in parts])
    return _Faces(sizes, corners, uv_corners)


def _check_range(path: Path, what: str, indices: NDArray[np.int64], count: int, first: int = 0) -> None:
    if len(indices) and (indices.min() < first or indices.max() >= count):
        raise TopologyError(
            f"{path}: found faces with {what} {int(indices.min()) + 1} to {int(indices.max()) + 1}, "
            f"expected 1 to {count}"
        )
