"""The neutral head of any identity: positions, quads, texture coordinates, annotations, skin."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.mesh import Mesh
from torchface.synthetic.annotations import annotations
from torchface.synthetic.identity import Anatomy, anatomy
from torchface.synthetic.skin import skin_texture
from torchface.synthetic.topology import topology
from torchface.synthetic.unwrap import unwrapping


def head(identity: Tensor | None = None, texture: bool = True) -> Mesh:
    """The neutral face of one person.

    Args:
        identity: coefficients (K,) in standard deviations, in the order of ``IDENTITY``; the mean if absent.
        texture: with painted skin.

    Returns:
        A mesh of quads with seams, 68 iBUG landmarks, regions, mirror map and contact pairs; float32. The lips stand
        0.1 mm apart, the lids are open.

    Raises:
        ShapeError: ``identity`` is not (K,).
        ValueRangeError: a coefficient is NaN or infinite.
    """
    return dress(anatomy(identity), texture)


def dress(person: Anatomy, texture: bool) -> Mesh:
    """The mesh of a head whose positions are known."""
    t, flat = topology(), unwrapping()
    return Mesh.from_polygons(
        person.vertices.float(),
        t.quads.clone(),
        flat.uvs.clone(),
        flat.quads.clone(),
        annotations=annotations(),
        texture=skin_texture() if texture else None,
    )


__all__ = ["head"]


def vertex_count() -> int:
    """How many vertices every head has."""
    return topology().count


def mirrored(delta: Tensor) -> Tensor:
    """A displacement (V,3) of the left side as one of the right."""
    return delta[topology().mirror] * torch.tensor([-1.0, 1.0, 1.0], dtype=delta.dtype)
