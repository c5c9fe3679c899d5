"""Wavefront OBJ: every vertex in the file's order, polygons and seams as authored."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.errors import FileFormatError, TopologyError
from torchface.files.whole_files import all_or_none, read_file, write_file
from torchface.io.images.image_files import encode_png, load_image
from torchface.io.length_units import finite_vertices, millimetres_per
from torchface.io.meshes.polygons import corners_of_polygons, pad_polygons
from torchface.mesh import Mesh

_MAX_MATERIAL_FILE = 2**20


def read_obj(path: str | Path, unit: str = "mm") -> Mesh:
    """The mesh in an OBJ file: polygons, texture coordinates with seams, vertex colours, the material's image.

    Args:
        path: the file; its material library and image are looked for beside it, never outside its folder.
        unit: the file's unit, ``"mm"``, ``"cm"`` or ``"m"``.

    Raises:
        FileFormatError: not an OBJ, no face, a number that is none, NaN, or an image that cannot be read.
        TopologyError: a face names a vertex that is not there.
    """
    path, scale = Path(path), millimetres_per(unit)
    lines = _lines_by_keyword(path, read_file(path))
    table = _number_rows(path, "v", lines["v"], (3, 4, 6, 7))
    if not len(table):
        raise FileFormatError(f"{path}: found no vertex (line 'v x y z'), expected an OBJ mesh")
    vertices = finite_vertices(path, table[:, :3] * scale)
    sizes, corners, uv_corners = _face_corners(path, lines, len(vertices))
    polygons = pad_polygons(str(path), sizes, corners)
    uvs, uv_polygons = _texture_coordinates(path, lines, sizes, uv_corners)
    colors = _colors(path, table)
    texture = _texture(path, lines)
    rest = {"colors": colors, "texture": texture}
    if polygons.shape[1] == 3:
        return Mesh(vertices, polygons, uvs, uv_polygons, **rest)  # type: ignore[arg-type]
    return Mesh.from_polygons(vertices, polygons, uvs, uv_polygons, **rest)  # type: ignore[arg-type]


def read_obj_vertices(path: str | Path, neutral: Mesh, topology: bytes | None, unit: str = "mm") -> Tensor:
    """The vertices (V,3) of a shape whose faces are those of ``neutral``; fast for many files.

    Args:
        path: the shape's file.
        neutral: the mesh at rest.
        topology: ``face_bytes`` of the neutral's file; a shape with the same bytes there is not parsed further.
        unit: the file's unit.

    Raises:
        FileFormatError: not an OBJ, or NaN.
        TopologyError: another number of vertices, or other faces.
    """
    path, data = Path(path), read_file(path)
    table = _plain_vertices(path, data)
    if table is None:
        table = _number_rows(path, "v", _lines_by_keyword(path, data)["v"], (3, 4, 6, 7))
    if len(table) != len(neutral.vertices):
        raise TopologyError(
            f"{path}: found {len(table)} vertices, expected the {len(neutral.vertices)} of the neutral mesh"
        )
    if topology is None or face_bytes(data) != topology:
        other = read_obj(path, unit)
        if not torch.equal(other.faces, neutral.faces):
            raise TopologyError(f"{path}: found other faces than in the neutral mesh, expected the same")
    return finite_vertices(path, table[:, :3] * millimetres_per(unit))


def face_bytes(data: bytes) -> bytes | None:
    """The file from its first face line on, to compare topologies without parsing them."""
    start = data.find(b"\nf ")
    return None if start < 0 else data[start:]


def write_obj(mesh: Mesh, path: str | Path) -> None:
    """Writes polygons (or triangles), seams and vertex colours, in millimetres; a texture beside it, with a material.

    Raises:
        FileFormatError: the folder cannot be written to.
    """
    path = Path(path)
    with all_or_none():
        if mesh.texture is not None:
            write_file(path.with_suffix(".png"), encode_png(mesh.texture))
            write_file(path.with_suffix(".mtl"), f"newmtl skin\nKd 1 1 1\nmap_Kd {path.stem}.png\n".encode())
        colors = None if mesh.colors is None else mesh.colors.detach().cpu().double().numpy()
        rows = _vertex_lines(mesh.vertices, colors)
        write_file(path, _material_line(mesh, path) + rows + _surface_lines(mesh))


def write_obj_shapes(mesh: Mesh, shapes: Iterable[tuple[str, Tensor]], neutral: str | Path) -> None:
    """Writes shapes of a mesh beside its own file, with the same faces and material.

    Args:
        mesh: the neutral, as ``write_obj`` wrote it.
        shapes: the name and the vertices (V,3) of each; its file is called so.
        neutral: the mesh's own file.

    Raises:
        FileFormatError: the folder cannot be written to.
    """
    surface, material = _surface_lines(mesh), _material_line(mesh, Path(neutral))
    with all_or_none():
        for name, vertices in shapes:  # a file each
            write_file(Path(neutral).with_name(f"{name}.obj"), material + _vertex_lines(vertices) + surface)


def _material_line(mesh: Mesh, path: Path) -> bytes:
    return b"" if mesh.texture is None else f"mtllib {path.stem}.mtl\n".encode()


def _vertex_lines(vertices: Tensor, colors: NDArray[np.float64] | None = None) -> bytes:
    positions = vertices.detach().cpu().double().numpy()
    columns = positions if colors is None else np.hstack([positions, colors])
    row = "v " + " ".join(["%.9g"] * columns.shape[1])
    return "".join([row % tuple(values) + "\n" for values in columns.tolist()]).encode()


def _surface_lines(mesh: Mesh) -> bytes:
    """Texture coordinates and faces."""
    text: list[str] = []
    sizes, corners, uv_corners = corners_of_polygons(mesh)
    if mesh.uvs is None:
        words = [str(i) for i in (corners + 1).tolist()]
    else:
        text += [f"vt {u:.9g} {v:.9g}" for u, v in mesh.uvs.detach().cpu().double().tolist()]
        words = [f"{i}/{j}" for i, j in zip((corners + 1).tolist(), (uv_corners + 1).tolist(), strict=True)]
    if mesh.texture is not None:
        text.append("usemtl skin")
    end = np.cumsum(sizes).tolist()
    text += ["f " + " ".join(words[e - n : e]) for e, n in zip(end, sizes.tolist(), strict=True)]
    return ("\n".join(text) + "\n").encode()


def _plain_vertices(path: Path, data: bytes) -> NDArray[np.float64] | None:
    """The vertices of a file whose first to last vertex line hold nothing but ``v x y z``; none of another file.

    All is split at once; every fourth word being the keyword, and a line a vertex, says that no line is odd.
    """
    start = 0 if data.startswith(b"v ") else data.find(b"\nv ") + 1
    last = data.rfind(b"\nv ") + 1
    end = data.find(b"\n", last)
    block = data[start : end if end >= 0 else None].rstrip()
    words = block.split()
    count = len(words) // 4
    if not count or len(words) % 4 or words[::4].count(b"v") != count or block.count(b"\n") != count - 1:
        return None
    del words[::4]
    return _floats(path, "v", words).reshape(count, 3)


def _floats(path: Path, keyword: str, words: Iterable[bytes]) -> NDArray[np.float64]:
    try:
        return np.array(list(map(float, words)), dtype=np.float64)
    except ValueError as error:
        raise FileFormatError(f"{path}: found text in a '{keyword}' line, expected numbers ({error})") from error


def _lines_by_keyword(path: Path, data: bytes) -> dict[str, list[bytes]]:
    """What follows the keyword, for the keywords that are read; text comes by the line, hence the loop."""
    if b"\0" in data[:4096]:
        raise FileFormatError(f"{path}: found binary data, expected the text of an OBJ")
    known: dict[bytes, list[bytes]] = {b"v": [], b"vt": [], b"f": [], b"mtllib": [], b"usemtl": []}
    vertices, coordinates, faces = known[b"v"], known[b"vt"], known[b"f"]
    for line in data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        words = line.split(None, 1)
        if len(words) == 2 and (rows := known.get(words[0])) is not None:
            rows.append(words[1])
            if rows is faces and b"-" in words[1]:  # a relative index counts back from the last vertex above it
                faces[-1] = _absolute(path, words[1], len(vertices), len(coordinates))
    return {keyword.decode(): rows for keyword, rows in known.items()}


def _absolute(path: Path, face: bytes, vertices: int, coordinates: int) -> bytes:
    """A face with its negative indices counted from the start."""
    corners = []
    for corner in face.split():
        parts = corner.split(b"/")
        for place, count in ((0, vertices), (1, coordinates)):
            if len(parts) > place and parts[place].startswith(b"-"):
                parts[place] = b"%d" % (count + 1 + _integers(path, [parts[place]])[0])
        corners.append(b"/".join(parts))
    return b" ".join(corners)


def _number_rows(path: Path, keyword: str, lines: Sequence[bytes], widths: Sequence[int]) -> NDArray[np.float64]:
    rows = [line.split() for line in lines]
    found = set(map(len, rows))
    if len(found) > 1 or not found <= set(widths):
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


def _face_corners(
    path: Path, lines: dict[str, list[bytes]], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64] | None]:
    """Corners a face (P,), vertex ids (C,), rows of the texture coordinates (C,) with -1 for none."""
    rows = [line.split() for line in lines["f"]]
    if not rows:
        raise FileFormatError(f"{path}: found {count} vertices and no face (line 'f'), expected at least one face")
    sizes = np.fromiter(map(len, rows), dtype=np.int64, count=len(rows))
    if sizes.min() < 3:
        raise FileFormatError(
            f"{path}: found {int(sizes.min())} corners in face {int(sizes.argmin())}, expected at least 3"
        )
    parts = [corner.split(b"/") for corner in chain.from_iterable(rows)]
    corners = _index_array(path, [part[0] for part in parts])
    _check_range(path, "vertex", corners, count)
    if not lines["vt"] or all(len(part) < 2 or not part[1] for part in parts):
        return sizes, corners, None
    uv_corners = _index_array(path, [part[1] if len(part) > 1 and part[1] else b"0" for part in parts])
    _check_range(path, "texture coordinate", uv_corners[uv_corners >= 0], len(lines["vt"]))
    return sizes, corners, uv_corners


def _check_range(path: Path, what: str, indices: NDArray[np.int64], count: int) -> None:
    if len(indices) and (indices.min() < 0 or indices.max() >= count):
        raise TopologyError(
            f"{path}: found faces with {what} {int(indices.min()) + 1} to {int(indices.max()) + 1}, "
            f"expected 1 to {count}"
        )


def _texture_coordinates(
    path: Path, lines: dict[str, list[bytes]], sizes: NDArray[np.int64], corners: NDArray[np.int64] | None
) -> tuple[Tensor | None, Tensor | None]:
    if corners is None:
        return None, None
    uvs = _number_rows(path, "vt", [b" ".join(line.split()[:2]) for line in lines["vt"]], (2,)).astype(np.float32)
    if not np.isfinite(uvs).all():
        raise FileFormatError(f"{path}: found NaN or infinity among the texture coordinates, expected finite numbers")
    if (corners < 0).any():  # faces without coordinates beside faces with them share one row at the origin
        corners = np.where(corners < 0, len(uvs), corners)
        uvs = np.vstack([uvs, np.zeros((1, 2), np.float32)])
    return torch.from_numpy(uvs), pad_polygons(str(path), sizes, corners)


def _colors(path: Path, table: NDArray[np.float64]) -> Tensor | None:
    if table.shape[1] < 6:
        return None
    colors = table[:, -3:]
    if not np.isfinite(colors).all():
        raise FileFormatError(f"{path}: found NaN or infinity among the vertex colours, expected numbers in [0,1]")
    scale = 255.0 if colors.max() > 1 else 1.0
    return torch.from_numpy((colors / scale).clip(0, 1).astype(np.float32))


def _texture(path: Path, lines: dict[str, list[bytes]]) -> Tensor | None:
    """The image of the first material in use that has one."""
    images: dict[str, str] = {}
    for library in lines["mtllib"]:
        file = _beside(path, library)
        if file is None or not file.is_file():
            continue  # exporters name libraries that nobody passes on; the mesh is whole without
        material = ""
        for line in read_file(file, _MAX_MATERIAL_FILE).decode("utf-8", "replace").splitlines():
            words = line.split()
            if len(words) >= 2 and words[0] == "newmtl":
                material = " ".join(words[1:])
            elif len(words) >= 2 and words[0] == "map_Kd":
                images.setdefault(material, words[-1])
    used = [name.decode("utf-8", "replace").strip() for name in dict.fromkeys(lines["usemtl"])]
    for name in used or list(images):
        image = _beside(path, images[name].encode()) if name in images else None
        if image is not None and image.is_file():
            return load_image(image)
    return None


def _beside(path: Path, name: bytes) -> Path | None:
    """The file of that name in the folder of ``path`` or below; none where the name leads out of it."""
    text = name.decode("utf-8", "replace").strip().replace("\\", "/")
    folder = path.resolve().parent
    try:
        file = (folder / text).resolve()
        return file if file.is_relative_to(folder) and len(text) < 1024 and file.exists() else None
    except (OSError, ValueError):
        return None
