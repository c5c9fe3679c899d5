"""PLY, ASCII and binary: vertices in the file's order, polygons, colours, a texture coordinate a vertex."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchface.errors import FileFormatError, TopologyError
from torchface.files.whole_files import read_file, write_file
from torchface.io.length_units import finite_vertices, millimetres_per
from torchface.io.meshes.ply_tables import Element, Lists, read_tables
from torchface.io.meshes.polygons import MESHING, corners_of_polygons, pad_polygons
from torchface.mesh import Mesh, fan_triangulation

_FACE_LISTS = ("vertex_indices", "vertex_index")
_UV_NAMES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))


def read_ply(path: str | Path, unit: str = "mm") -> Mesh:
    """The mesh in a PLY file of ``mm``, ``cm`` or ``m``."""
    path, scale = Path(path), millimetres_per(unit)
    tables, elements = read_tables(path, read_file(path), ("vertex", "face"))
    columns = tables.get("vertex", {})
    if not all(isinstance(columns.get(axis), np.ndarray) and len(columns[axis]) for axis in "xyz"):
        raise FileFormatError(f"{path}: found no vertices with x, y and z, expected a PLY mesh")
    vertices = finite_vertices(path, np.stack([columns[axis] for axis in "xyz"], axis=1) * scale)
    lists = next((rows for name in _FACE_LISTS if isinstance(rows := tables.get("face", {}).get(name), Lists)), None)
    if lists is None or len(lists.sizes) == 0:
        raise FileFormatError(
            f"{path}: found {len(vertices)} vertices and no face, expected at least one face; {MESHING}"
        )
    if lists.sizes.min() < 3:
        raise FileFormatError(f"{path}: found a face of {int(lists.sizes.min())} corners, expected at least 3")
    corners = lists.values
    if not (corners.min() >= 0 and corners.max() < len(vertices) and (corners.astype(np.int64) == corners).all()):
        raise TopologyError(
            f"{path}: found faces with vertex {corners.min():g} to {corners.max():g}, "
            f"expected 0 to {len(vertices) - 1}, whole numbers"
        )
    polygons = pad_polygons(str(path), lists.sizes, corners.astype(np.int64))
    triangles = fan_triangulation(polygons)
    uvs, colors = _uvs(path, columns), _colors(path, columns, elements)
    authored = None if polygons.shape[1] == 3 else polygons
    return Mesh(vertices, triangles, uvs, None if uvs is None else triangles, colors, polygons=authored)


def write_ply(mesh: Mesh, path: str | Path) -> None:
    """Writes polygons (or triangles) and vertex colours, binary, in millimetres."""
    positions = mesh.vertices.detach().cpu().numpy()
    fields: list[tuple[str, str]] = [(axis, "<f4") for axis in "xyz"]
    if mesh.colors is not None:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
    table = np.zeros(len(positions), dtype=fields)
    for i, axis in enumerate("xyz"):
        table[axis] = positions[:, i]
    if mesh.colors is not None:
        coded = mesh.colors.detach().cpu().clamp(0, 1).mul(255).round().numpy()
        for i, name in enumerate(("red", "green", "blue")):
            table[name] = coded[:, i]
    sizes, corners, _ = corners_of_polygons(mesh)
    if len(sizes) and sizes.max() > 255:
        raise TopologyError(f"{path}: the mesh has a polygon of {int(sizes.max())} corners; PLY takes at most 255")
    header = ["ply", "format binary_little_endian 1.0", "comment torchface", f"element vertex {len(table)}"]
    header += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in fields]
    header += [f"element face {len(sizes)}", "property list uchar int vertex_indices", "end_header"]
    # Each face is a byte and then four for every corner; all are laid out at once.
    rows = np.zeros(len(sizes) + 4 * len(corners), np.uint8)
    begin = np.arange(len(sizes)) + 4 * (np.cumsum(sizes) - sizes)
    rows[begin] = sizes
    body = np.ones(len(rows), bool)
    body[begin] = False
    rows[body] = corners.astype("<i4").view(np.uint8)
    write_file(path, ("\n".join(header) + "\n").encode() + table.tobytes() + rows.tobytes())


def _colors(path: Path, columns: dict[str, Any], elements: list[Element]) -> torch.Tensor | None:
    names = ("red", "green", "blue")
    if not all(isinstance(columns.get(name), np.ndarray) for name in names):
        return None
    kinds = {name: kind for element in elements if element.name == "vertex" for name, kind, _ in element.properties}
    coded = np.stack([columns[name] / (255.0 if kinds[name] == "u1" else 1.0) for name in names], axis=1)
    if not np.isfinite(coded).all():
        raise FileFormatError(f"{path}: found NaN or infinity among the vertex colours, expected numbers")
    return torch.from_numpy(coded.clip(0, 1).astype(np.float32))


def _uvs(path: Path, columns: dict[str, Any]) -> torch.Tensor | None:
    for u, v in _UV_NAMES:
        if isinstance(columns.get(u), np.ndarray) and isinstance(columns.get(v), np.ndarray):
            with np.errstate(over="ignore"):
                uvs = np.stack([columns[u], columns[v]], axis=1).astype(np.float32)
            if not np.isfinite(uvs).all():
                raise FileFormatError(f"{path}: found NaN or infinity among the texture coordinates, expected numbers")
            return torch.from_numpy(uvs)
    return None
