"""The embedded performer: a head of any identity with 51 of ARKit's 52 shapes."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.identity import Anatomy, anatomy, mirrored
from torchface.synthetic.head.lower_face_shapes import lower_face
from torchface.synthetic.head.skin_texture import skin_texture
from torchface.synthetic.head.topology import topology
from torchface.synthetic.head.upper_face_shapes import upper_face
from torchface.synthetic.head.uv_layout import unwrapping

SHAPES: tuple[str, ...] = tuple(name for name in ARKIT if name != "tongueOut")
"""The performer's shapes, in ARKit's order."""


def performer(identity: Tensor | None = None, texture: bool = True) -> BlendshapeRig:
    """A whole rig made by code; every performer has the same topology.

    Args:
        identity: coefficients (K,) in standard deviations, in the order of ``IDENTITY``; the mean if absent.
        texture: with painted skin.

    Returns:
        The rig: ``neutral_head(identity)`` as its neutral and ARKit's shapes but ``tongueOut``. Their size and form
        depend smoothly on the identity; left and right shapes are mirror images.

    Raises:
        ShapeError: ``identity`` is not (K,).
        ValueRangeError: a coefficient is NaN or infinite.

    Example:
        >>> rig = performer(texture=False)
        >>> open_jaw = rig.vertices.new_zeros(1, len(rig.names))
        >>> open_jaw[0, rig.index(["jawOpen"])] = 1
        >>> chin = rig.neutral.landmarks[8]
        >>> bool(rig(open_jaw)[0, chin, 1] < rig.vertices[chin, 1] - 10)
        True
    """
    person = anatomy(identity)
    made = upper_face(person) | lower_face(person)
    for name in list(made):
        if name.endswith("Left"):
            made[name.removesuffix("Left") + "Right"] = mirrored(made[name])
    deltas = torch.stack([made[name] for name in SHAPES])
    return BlendshapeRig(dress(person, texture), deltas.float(), SHAPES)


def neutral_head(identity: Tensor | None = None, texture: bool = True) -> Mesh:
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

    Example:
        >>> head = neutral_head(texture=False)
        >>> height = head.vertices[:, 1].max() - head.vertices[:, 1].min()
        >>> len(head.landmarks), bool(150 < height < 400)
        (68, True)
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
        annotations=head_annotations(),
        texture=skin_texture() if texture else None,
    )
