"""Vertices, triangles, texture coordinates and colours as a ``trimesh.Trimesh``, and back.

``trimesh`` has one texture coordinate a vertex, so seams split vertices; ``vertex_attributes["vertex_id"]`` says which
vertex each row was. It is imported where it is needed, since it takes a while.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from torchface.errors import ShapeError
from torchface.geometry.meshes.uv_seams import split_at_seams

if TYPE_CHECKING:
    import trimesh


def to_trimesh(
    vertices: Tensor,
    faces: Tensor,
    uvs: Tensor | None = None,
    uv_faces: Tensor | None = None,
    colors: Tensor | None = None,
    texture: Tensor | None = None,
) -> "trimesh.Trimesh":
    """The ``trimesh.Trimesh`` of a mesh; see ``Mesh.to_trimesh`` for what is lost."""
    import trimesh

    triangles = faces.cpu().numpy()
    split = split_at_seams(len(vertices), triangles, None if uv_faces is None else uv_faces.cpu().numpy())
    ids, uv_of = split.vertex_of, split.uv_of
    if uv_of is not None and len(ids) == len(vertices):  # no seam: the mesh's own order
        uv_of, ids = uv_of[np.argsort(ids)], np.arange(len(vertices))
    else:
        triangles = split.triangles
    coded = None if colors is None else _eight_bits(colors)[ids]
    attributes: dict[str, Any] = {"vertex_id": ids}
    visual: Any = None
    if uvs is not None:
        image = None if texture is None else Image.fromarray(_eight_bits(texture.permute(1, 2, 0)))
        material = trimesh.visual.material.SimpleMaterial(image=image)
        visual = trimesh.visual.TextureVisuals(uvs.detach().cpu().double().numpy()[uv_of], material)
        attributes |= {} if coded is None else {"color": coded}
    elif coded is not None:
        visual = trimesh.visual.ColorVisuals(vertex_colors=coded)
    points = vertices.detach().cpu().double().numpy()[ids]
    return trimesh.Trimesh(points, triangles, visual=visual, vertex_attributes=attributes, process=False)


def from_trimesh(mesh: "trimesh.Trimesh") -> dict[str, Any]:
    """The arguments of ``Mesh``: vertices, faces, uvs, uv_faces, colors, texture."""
    import trimesh

    if not isinstance(mesh, trimesh.Trimesh):
        raise ShapeError(
            f"from_trimesh: found a {type(mesh).__name__}, expected a trimesh.Trimesh; of a scene take "
            "scene.to_geometry()"
        )
    ids, row_of = _joined(mesh)
    rows = np.array(mesh.faces, np.int64)
    visual: Any = mesh.visual
    parts = {
        "vertices": torch.tensor(np.asarray(mesh.vertices)[row_of], dtype=torch.float32),
        "faces": torch.from_numpy(ids[rows]),
    }
    colors = mesh.vertex_attributes.get("color")
    if isinstance(visual, trimesh.visual.TextureVisuals):
        if visual.uv is not None and len(visual.uv) == len(mesh.vertices):
            parts["uvs"] = torch.tensor(np.asarray(visual.uv)[:, :2], dtype=torch.float32)
            parts["uv_faces"] = torch.from_numpy(rows)
            material = visual.material
            image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
            if image is not None:
                parts["texture"] = torch.tensor(np.asarray(image.convert("RGB"))).permute(2, 0, 1) / 255
    elif visual.kind is not None:
        colors = visual.vertex_colors
    if colors is not None:
        parts["colors"] = torch.tensor(np.asarray(colors)[row_of, :3]) / 255
    return parts


def _joined(mesh: "trimesh.Trimesh") -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The vertex that each row is, and a row of each vertex; one to one where there are no ids or rows have moved."""
    ids, each = mesh.vertex_attributes.get("vertex_id"), np.arange(len(mesh.vertices))
    if ids is None or np.shape(ids) != each.shape or np.asarray(ids).dtype.kind not in "iu":
        return each, each
    _, row_of, ids = np.unique(ids, return_index=True, return_inverse=True)
    return (ids, row_of) if np.array_equal(mesh.vertices, mesh.vertices[row_of[ids]]) else (each, each)


def _eight_bits(values: Tensor) -> NDArray[np.uint8]:
    return values.detach().cpu().clamp(0, 1).mul(255).round().to(torch.uint8).numpy()
