"""The 68 landmarks of a rig that has none, from where its shapes move the skin."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.geometry.similarity import similarity_transform
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic.head.performer import performer

_MIN_SHAPES = 12
# Eyes and tongue are parts of their own on many rigs; jaws carry beards and necks along on some.
_NOT_OF_THE_SKIN = ("eyeLook", "tongue", "jaw")


def landmarks_by_shape(rig: BlendshapeRig) -> Tensor:
    """Landmarks (68,3), millimetres, float64: the embedded performer's, moved by a similarity.

    It takes the place at which each of ARKit's shapes moves the performer to that at which it moves the rig. Within
    2 mm on other performers; on another family of heads within 6 mm inside the face, more along the jaw.

    Args:
        rig: with shapes whose names mean ARKit's; see ``torchface.shape_names.mapping``.

    Raises:
        ValueRangeError: too few shapes have such names.
    """
    known = performer(texture=False)
    ours, here = _places(known), _places(rig)
    both = [name for name in ours if name in here]
    if len(both) < _MIN_SHAPES:
        raise ValueRangeError(
            f"rig: found no 68 landmarks and {len(both)} shapes with ARKit's names, expected landmarks or at least "
            f"{_MIN_SHAPES} such shapes; landmarks are set with: torchface pick RIG"
        )
    source = torch.stack([ours[name] for name in both])
    target = torch.stack([here[name] for name in both])
    points = known.vertices.double()[known.neutral.landmarks]
    return similarity_transform(source[None], target[None]).apply(points[None])[0]


def _places(rig: BlendshapeRig) -> dict[str, Tensor]:
    """Where each of ARKit's shapes moves the rig: the mean place, weighted by the squared motion."""
    table = mapping(ARKIT, rig.names).T.double()
    vertices, deltas = rig.vertices.detach().cpu().double(), rig.deltas.detach().cpu()
    found = {}
    for name, row in zip(ARKIT, table, strict=True):
        if name.startswith(_NOT_OF_THE_SKIN) or not bool(row.any()):
            continue
        motion = torch.einsum("n,nvc->vc", row.to(deltas), deltas).double().square().sum(-1)
        if float(motion.sum()) > 0:
            found[name] = (motion[:, None] * vertices).sum(0) / motion.sum()
    return found
