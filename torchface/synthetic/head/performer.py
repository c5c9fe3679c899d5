"""The embedded performer: a head of any identity with 51 of ARKit's 52 shapes."""

from functools import cache

import torch
from torch import Tensor

from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT
from torchface.synthetic.head.identity import Anatomy, anatomy, mirrored
from torchface.synthetic.head.lower_face_shapes import lower_face
from torchface.synthetic.head.neutral_head import dress
from torchface.synthetic.head.upper_face_shapes import upper_face

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
    deltas = _mean_deltas().clone() if identity is None else _deltas(person)
    return BlendshapeRig(dress(person, texture), deltas, SHAPES)


@cache
def _mean_deltas() -> Tensor:
    """Those of the mean performer, who is asked for most."""
    return _deltas(anatomy())


def _deltas(person: Anatomy) -> Tensor:
    made = upper_face(person)
    for name, moved in lower_face(person).items():
        made[name] = made[name] + moved if name in made else moved
    for name in list(made):
        if name.endswith("Left"):
            made[name.removesuffix("Left") + "Right"] = mirrored(made[name])
    return torch.stack([made[name] for name in SHAPES]).float()
