"""STL, ASCII and binary: triangles whose equal corners become one vertex."""

import re
from array import array
from io import BytesIO
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file, write_file
from torchface.geometry.meshes.uv_seams import merge_equal_rows
from torchface.io.length_units import finite_vertices, millimetres_per
from torchface.mesh import Mesh

_HEADER, _RECORD = 84, 50
_AT_ONCE = 2**15  # corners; the words of all take twenty times the memory of their text
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")


def read_stl(path: str | Path, unit: str = "mm") -> Mesh:
    """The mesh in an STL file of ``mm``, ``cm`` or ``m``; vertices are numbered by first appearance."""
    from trimesh.exchange.stl import load_stl_binary  # takes a while to import

    path, scale = Path(path), millimetres_per(unit)
    data = read_file(path)
    count = int.from_bytes(data[80:84], "little")
    size = _HEADER + count * _RECORD
    # A binary file may begin with "solid" too: its length decides.
    if len(data) == size and count:
        points = np.asarray(load_stl_binary(BytesIO(data))["vertices"], np.float64)
    elif data.lstrip()[:5].lower() == b"solid" and b"\0" not in data[:_HEADER]:
        points = _ascii(path, data)
    elif len(data) != size:
        raise FileFormatError(
            f"{path}: found {len(data)} bytes for {count} triangles (truncated, or no STL), expected {size}"
        )
    else:
        points = np.zeros((0, 3))
    if len(points) == 0:
        raise FileFormatError(f"{path}: found no triangle, expected at least one")
    vertices = finite_vertices(path, points * scale)
    vertex_of, first = merge_equal_rows(vertices.numpy())
    return Mesh(vertices[first] + 0.0, torch.from_numpy(vertex_of.reshape(-1, 3)))


def write_stl(mesh: Mesh, path: str | Path) -> None:
    """Writes triangles, binary, in millimetres."""
    from trimesh.exchange.stl import export_stl

    write_file(path, export_stl(mesh.to_trimesh()))


def _ascii(path: Path, data: bytes) -> NDArray[np.float64]:
    numbers = array("d")
    try:
        matches = _VERTEX.finditer(data.lower())
        while words := [word for match in islice(matches, _AT_ONCE) for word in match.groups()]:
            numbers.extend(map(float, words))
    except ValueError as error:
        raise FileFormatError(f"{path}: found text in a vertex line, expected numbers ({error})") from error
    if len(numbers) % 9:
        raise FileFormatError(f"{path}: found {len(numbers) // 3} corners (truncated), expected three a triangle")
    return np.frombuffer(numbers).reshape(-1, 3) if numbers else np.zeros((0, 3))
