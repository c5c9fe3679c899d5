"""Wavefront OBJ: every vertex in the file's order, polygons and seams as authored."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.errors import FileFormatError, TopologyError
from torchface.files.files_beside import free_stem, write_beside
from torchface.files.whole_files import all_or_none, read_file, write_file
from torchface.io.images.image_files import encode_png, load_image
from torchface.io.images.texture_atlas import MAX_TEXELS, Look, with_looks
from torchface.io.length_units import finite_vertices, millimetres_per
from torchface.io.meshes.obj_statements import Statements, read_statements, read_vertices, texture_coordinates
from torchface.io.meshes.polygons import corners_of_polygons, pad_polygons
from torchface.mesh import Mesh

_MAX_MATERIALS = 2**20  # bytes, of all material files of a mesh


def read_obj(path: str | Path, unit: str = "mm") -> Mesh:
    """The mesh in an OBJ file: polygons, texture coordinates with seams, vertex colours, the material's image.

    The material library and image are looked for beside the file, never outside its folder. Its unit is ``"um"``,
    ``"mm"``, ``"cm"``, ``"m"`` or ``"in"``.
    """
    path, scale = Path(path), millimetres_per(unit)
    statements = read_statements(path, read_file(path))
    vertices = finite_vertices(path, statements.vertices[:, :3] * scale)
    polygons = pad_polygons(str(path), statements.sizes, statements.corners)
    uvs, uv_polygons = _texture_coordinates(path, statements)
    colors, (looks, look) = _colors(path, statements.vertices), _looks(path, statements)
    look = look.repeat_interleave(torch.from_numpy(statements.sizes) - 2)
    del statements  # a large mesh fits the memory once, not twice
    make = Mesh if polygons.shape[1] == 3 else Mesh.from_polygons
    return with_looks(make(vertices, polygons, uvs, uv_polygons, colors=colors), look, looks)


def read_obj_vertices(path: str | Path, neutral: Mesh, topology: bytes | None, unit: str = "mm") -> Tensor:
    """The vertices (V,3) of a shape whose faces are those of the mesh at rest; the same face bytes are not parsed
    further."""
    path, data = Path(path), read_file(path)
    table = read_vertices(path, data)
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


def write_obj(mesh: Mesh, path: str | Path) -> str:
    """Writes polygons (or triangles), seams, vertex colours, in millimetres; a texture beside it, with a material.

    Returns:
        What the names of the texture and the material begin with: the file's own name, unless the user has such files.
    """
    path = Path(path)
    stem = path.stem
    with all_or_none():
        if mesh.texture is not None:
            picture = encode_png(mesh.texture)
            stem = free_stem(path, stem, _material(stem, picture))
            write_beside(path, _material(stem, picture))
        colors = None if mesh.colors is None else mesh.colors.detach().cpu().double().numpy()
        rows = _vertex_lines(mesh.vertices, colors)
        write_file(path, _material_line(mesh, stem) + rows + _surface_lines(mesh))
    return stem


def write_obj_shapes(mesh: Mesh, shapes: Iterable[tuple[str, Tensor]], folder: Path, stem: str) -> None:
    """Writes shapes of a mesh, vertices (V,3) by name, with its faces and the material that ``write_obj`` returned."""
    surface, material = _surface_lines(mesh), _material_line(mesh, stem)
    with all_or_none():
        for name, vertices in shapes:  # a file each
            write_file(folder / f"{name}.obj", material + _vertex_lines(vertices) + surface)


def _material(stem: str, picture: bytes) -> dict[str, bytes]:
    return {f"{stem}.png": picture, f"{stem}.mtl": f"newmtl skin\nKd 1 1 1\nmap_Kd {stem}.png\n".encode()}


def _material_line(mesh: Mesh, stem: str) -> bytes:
    return b"" if mesh.texture is None else f"mtllib {stem}.mtl\n".encode()


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


def _texture_coordinates(path: Path, statements: Statements) -> tuple[Tensor | None, Tensor | None]:
    corners = statements.uv_corners
    if corners is None:
        return None, None
    uvs = texture_coordinates(path, statements.coordinates)
    if (corners < 0).any():  # faces without coordinates beside faces with them share one row at the origin
        corners = np.where(corners < 0, len(uvs), corners)
        uvs = np.vstack([uvs, np.zeros((1, 2), np.float32)])
    return torch.from_numpy(uvs), pad_polygons(str(path), statements.sizes, corners)


def _colors(path: Path, table: NDArray[np.float64]) -> Tensor | None:
    if table.shape[1] < 6:
        return None
    colors = table[:, -3:]
    if not np.isfinite(colors).all():
        raise FileFormatError(f"{path}: found NaN or infinity among the vertex colours, expected numbers in [0,1]")
    scale = 255.0 if colors.max() > 1 else 1.0
    return torch.from_numpy((colors / scale).clip(0, 1).astype(np.float32))


def _looks(path: Path, statements: Statements) -> tuple[list[Look], Tensor]:
    """The images and plain colours of the materials in use, and which of them each face has, (P,).

    Without any image there is one look; materials that no library has look like the first one with an image.
    """
    kinds = _materials(path, statements.libraries)
    used = [(name.decode("utf-8", "replace").strip(), first) for name, first in statements.materials]
    used = [(name, 0 if not row else first) for row, (name, first) in enumerate(used or [(n, 0) for n in kinds][:1])]
    images = {name: _image_beside(path, kinds[name][0]) for name, _ in used if name in kinds}
    first_image = next((file for file in images.values() if file is not None), None)
    if first_image is None:
        return [Look(None)], torch.zeros(len(statements.sizes), dtype=torch.int64)
    keys: dict[tuple[Path | None, tuple[float, ...]], int] = {}
    rows = []
    for name, _ in used:
        file = images.get(name, first_image)
        rows.append(keys.setdefault((file, kinds[name][1] if file is None else ()), len(keys)))
    looks, texels = [], 0
    for file, color in keys:
        looks.append(Look(None, torch.tensor(color)) if file is None else Look(load_image(file)))
        image = looks[-1].image
        texels += 0 if image is None else image[0].numel()
        if texels > MAX_TEXELS:
            raise FileFormatError(f"{path}: found images of more than {MAX_TEXELS:,} texels, expected fewer")
    begin = torch.tensor([first for _, first in used] + [len(statements.sizes)])
    return looks, torch.tensor(rows).repeat_interleave(begin.diff())


def _materials(path: Path, libraries: Iterable[bytes]) -> dict[str, tuple[str, tuple[float, ...]]]:
    """The name of the image, "" for none, and the colour of each material."""
    found: dict[str, tuple[str, tuple[float, ...]]] = {}
    opened: set[Path] = set()
    left = _MAX_MATERIALS
    for library in libraries:
        file = _beside(path, library)
        if file is None or file in opened or not file.is_file():
            continue  # exporters name libraries that nobody passes on; the mesh is whole without
        text = read_file(file, left)
        opened.add(file)
        left -= len(text)
        material = ""
        for line in text.decode("utf-8", "replace").splitlines():
            words = line.split()
            if len(words) >= 2 and words[0] == "newmtl":
                material = " ".join(words[1:])
                found.setdefault(material, ("", (1.0, 1.0, 1.0)))
            elif len(words) >= 2 and words[0] == "map_Kd":
                image, color = found.get(material, ("", (1.0, 1.0, 1.0)))
                found[material] = image or words[-1], color
            elif len(words) == 4 and words[0] == "Kd" and material in found:
                found[material] = found[material][0], _color(words[1:], found[material][1])
    return found


def _color(words: list[str], otherwise: tuple[float, ...]) -> tuple[float, ...]:
    try:
        return tuple(min(max(float(word), 0.0), 1.0) for word in words)
    except ValueError:
        return otherwise


def _image_beside(path: Path, name: str) -> Path | None:
    file = _beside(path, name.encode()) if name else None
    return file if file is not None and file.is_file() else None


def _beside(path: Path, name: bytes) -> Path | None:
    """The file of that name in the folder of ``path`` or below; none where the name leads out of it."""
    text = name.decode("utf-8", "replace").strip().replace("\\", "/")
    folder = path.resolve().parent
    try:
        file = (folder / text).resolve()
        return file if file.is_relative_to(folder) and len(text) < 1024 and file.exists() else None
    except (OSError, ValueError):
        return None
