"""The part of the embedded performer that a capture stage sees."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.geometry.meshes.operators import border_edges, components
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig
from torchface.synthetic.head.performer import performer

_NOT_SKIN = ("eyeball_left", "eyeball_right", "eye_sockets", "mouth_interior", "ear_left", "ear_right")
_BACK, _NECK, _CROWN = 3.0, -140.0, 30.0  # millimetres: what is behind, below, and above-and-behind is left out
_RIM_ITERATIONS = 30


def performer_face(identity: Tensor | None = None) -> BlendshapeRig:
    """Skin from the neck to the crown and before the ears, with 68 landmarks and regions.

    Eyes and the inside of the mouth are left out: lids and lips are borders, as in a captured mesh.

    Args:
        identity: see ``performer``.
    """
    head = performer(identity, texture=False)
    face = head.part(captured_skin(head))
    return BlendshapeRig(face.neutral.with_vertices(_smooth_rim(face.neutral)), face.deltas, face.names)


def captured_skin(head: BlendshapeRig) -> Tensor:
    """Which vertices of a performer are of that part, (V,) bool."""
    assert head.neutral.annotations is not None
    places, regions = head.neutral.vertices, head.neutral.annotations.regions
    hidden = torch.stack([regions[name] for name in _NOT_SKIN]).any(0)
    front = places[:, 2] > _BACK + 0.6 * (places[:, 1] - _CROWN).clamp(min=0)
    return ~hidden & front & (places[:, 1] > _NECK)


def _smooth_rim(cut: Mesh) -> Tensor:
    """Vertices (V,3) whose longest border is smooth; the cut along edges has left it in steps."""
    opposite = border_edges(cut.faces)
    pairs = torch.cat([cut.faces[:, [corner - 2, corner - 1]][opposite[:, corner]] for corner in range(3)])
    loop = components(torch.cat([pairs, pairs[:, :1]], dim=1), len(cut.vertices))[pairs[:, 0]]
    start, end = pairs[loop == loop.mode().values].T
    start, end = torch.cat([start, end]), torch.cat([end, start])
    rim, vertices = start.unique(), cut.vertices.clone()
    for _ in range(_RIM_ITERATIONS):
        beside = torch.zeros_like(vertices).index_add_(0, start, vertices[end])
        vertices[rim] = 0.5 * vertices[rim] + 0.25 * beside[rim]
    return vertices
