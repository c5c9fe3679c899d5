"""A head cut into pieces of one colour each, so that the page gets only the pieces that moved."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.cluster.vq import kmeans2
from torch import Tensor

from torchface.geometry.meshes.operators import components
from torchface.mesh import Mesh
from torchface.rendering.part_colors import clear_triangles, triangle_colors

_MAX_COMPONENTS = 16
_MAX_COLORS = 6
_MIN_COLOR_DISTANCE = 0.72  # over the number of colours
_MIN_FRACTION = 0.006


@dataclass(frozen=True, eq=False)
class Part:
    """Some triangles of a mesh in one colour."""

    vertex_ids: Tensor  # which vertices of the mesh, (V',) int64
    faces: Tensor  # triangles into those, (F',3) int64
    color: tuple[float, float, float]  # in [0,1]


def split_parts(mesh: Mesh) -> list[Part]:
    """The mesh cut by connected component and by colour, largest piece first.

    Colours are those of the texture, else of the vertices, else of what regions are named; few classes, for shapes in
    motion. Every triangle lands in one part, but for those of clear shells over the eye and of lashes.
    """
    mesh = mesh.to("cpu")
    colors, drawn = _triangle_colors(mesh)
    component = _components(mesh)
    classes, palette = _color_classes(colors, _MAX_COLORS)
    piece = torch.where(drawn, component * len(palette) + classes, -1)
    # A few triangles of a stray colour do not deserve a part of their own: they take their component's main one.
    for number in component.unique().tolist():
        members = (component == number) & drawn
        if not members.any():
            continue
        counts = torch.bincount(classes[members], minlength=len(palette))
        stray = counts < _MIN_FRACTION * int(members.sum())
        piece[members & stray[classes]] = number * len(palette) + int(counts.argmax())
    parts = []
    for label in piece.unique().tolist():
        if label < 0:
            continue
        inside = piece == label
        ids, local = mesh.faces[inside].unique(return_inverse=True)
        red, green, blue = colors[inside].mean(0).tolist()
        parts.append(Part(ids, local, (red, green, blue)))
    return sorted(parts, key=lambda part: -len(part.faces))


def triangle_texture(mesh: Mesh) -> Tensor:
    """The texture's colour (F,3) in the middle of each triangle; the mesh has texture and UVs."""
    assert mesh.texture is not None
    assert mesh.uvs is not None
    assert mesh.uv_faces is not None
    height, width = mesh.texture.shape[1:]
    middle = mesh.uvs[mesh.uv_faces].mean(1)
    column = (middle[:, 0] * width).long().remainder(width)
    row = ((1 - middle[:, 1]) * height).long().remainder(height)
    return mesh.texture[:, row, column].T


def _triangle_colors(mesh: Mesh) -> tuple[Tensor, Tensor]:
    """Colours (F,3), and which triangles are drawn, (F,)."""
    count = len(mesh.faces)
    if mesh.texture is not None and mesh.uvs is not None:
        return triangle_texture(mesh).float(), torch.ones(count, dtype=torch.bool)
    if mesh.colors is not None:
        return mesh.colors[mesh.faces].mean(1).float(), torch.ones(count, dtype=torch.bool)
    return triangle_colors(mesh), ~clear_triangles(mesh)


def _components(mesh: Mesh) -> Tensor:
    """A number a triangle; the smaller components share the last."""
    label = components(mesh.faces, len(mesh.vertices))[mesh.faces[:, 0]]
    size = torch.bincount(label)
    rank = torch.empty_like(size)
    rank[size.argsort(descending=True, stable=True)] = torch.arange(len(size))
    return rank[label].clamp(max=_MAX_COMPONENTS - 1)


def _color_classes(colors: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """A class (F,) and the palette (K,3): k-means from colours that lie far from each other."""
    points = colors.double().numpy()
    centres = [points[np.linalg.norm(points - points.mean(0), axis=1).argmin()]]
    while len(centres) < most:
        distance = np.min([np.linalg.norm(points - centre, axis=1) for centre in centres], axis=0)
        if distance.max(initial=0.0) < _MIN_COLOR_DISTANCE / most:
            break
        centres.append(points[distance.argmax()])
    palette, label = kmeans2(points, np.stack(centres), minit="matrix", missing="warn")
    return torch.from_numpy(label.astype(np.int64)), torch.from_numpy(palette)
