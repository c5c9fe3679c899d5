"""STL, ASCII and binary: triangles whose equal corners become one vertex."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file, write_file
from torchface.io.length_units import finite_vertices, millimetres_per
from torchface.mesh import Mesh

_HEADER = 84
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")


def read_stl(path: str | Path, unit: str = "mm") -> Mesh:
    """The mesh in an STL file; vertices are numbered by first appearance.

    Args:
        path: the file.
        unit: the file's unit, ``"mm"``, ``"cm"`` or ``"m"``.

    Raises:
        FileFormatError: not an STL, truncated, without triangles, or with NaN.
    """
    path, scale = Path(path), millimetres_per(unit)
    data = read_file(path)
    count = int.from_bytes(data[80:84], "little")
    # A binary file may begin with "solid" too: its length tells.
    if len(data) >= _HEADER and len(data) == _HEADER + count * _RECORD.itemsize:
        points = np.frombuffer(data, _RECORD, count, _HEADER)["corners"].reshape(-1, 3).astype(np.float64)
    elif data.lstrip()[:5].lower() == b"solid" and b"\0" not in data[:_HEADER]:
        points = _ascii(path, data)
    else:
        raise FileFormatError(
            f"{path}: found {len(data)} bytes for {count} triangles (truncated, or no STL), "
            f"expected {_HEADER + count * _RECORD.itemsize}"
        )
    if len(points) == 0:
        raise FileFormatError(f"{path}: found no triangle, expected at least one")
    vertices = finite_vertices(path, points * scale).numpy() + np.float32(0)  # -0 and 0 are one place
    _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    faces = rank[inverse.reshape(-1)].reshape(-1, 3)
    return Mesh(torch.from_numpy(vertices[first[order]]), torch.from_numpy(faces))


def write_stl(mesh: Mesh, path: str | Path, unit: str = "mm") -> None:
    """Writes triangles, binary.

    Raises:
        FileFormatError: the folder cannot be written to.
    """
    corners = (mesh.vertices.detach().cpu().double() / millimetres_per(unit)).numpy()[mesh.faces.cpu().numpy()]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    records = np.zeros(len(corners), _RECORD)
    records["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    records["corners"] = corners
    write_file(path, b"torchface".ljust(80) + len(corners).to_bytes(4, "little") + records.tobytes())


def _ascii(path: Path, data: bytes) -> NDArray[np.float64]:
    words = [word for match in _VERTEX.finditer(data.lower()) for word in match.groups()]
    try:
        numbers = np.array(list(map(float, words)), dtype=np.float64)
    except ValueError as error:
        raise FileFormatError(f"{path}: found text in a vertex line, expected numbers ({error})") from error
    if len(numbers) % 9:
        raise FileFormatError(f"{path}: found {len(numbers) // 3} corners (truncated), expected three a triangle")
    return numbers.reshape(-1, 3)
