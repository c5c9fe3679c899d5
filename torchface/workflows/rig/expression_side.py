"""Whether a scanned expression shows the side that it is named for: the one trace that mirrored scans leave."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.errors import AlignmentError
from torchface.geometry.meshes.operators import vertex_normals
from torchface.rig import BlendshapeRig
from torchface.shape_names import mirror

# Millimetres between an expression and its mirror image where the two are told apart at all.
_TELLING = 1.0
_LEAST_VERTICES = 20
# Of the way from the middle between the two: 1 is what was asked for, -1 its mirror image; a weak expression is near 0.
# Mirrored scans of another performer's smile, brow and jaw come to -0.5 to -0.8, right ones to 0.9 and more.
_CLEARLY_OTHER = -0.35


def check_side(actor: BlendshapeRig, weights: Tensor, found: Tensor, seen: Tensor) -> None:
    r"""Compares a registered expression with what was asked for and with its mirror image.

    .. math:: s = \frac{(x - m)^\top d}{d^\top d}, \qquad m = \tfrac12 (a + a'), \; d = \tfrac12 (a - a')

    of the expression a asked for and its mirror image a', along the skin's normals: what both sides do alike does not
    count, nor does what slides along the skin, which no registration sees.

    A head alone looks like another head when it is mirrored; an expression of one side tells.

    Args:
        actor: the transferred rig.
        weights: of the expression, (N,).
        found: the registered vertices, laid on the rig, (V,3).
        seen: vertices that the scan shows, (V,) bool.

    Raises:
        AlignmentError: it is clearly the mirror image.
    """
    weights = weights.to(actor.deltas)
    swapped = weights[mirror(actor.names).to(weights.device)]
    if torch.equal(swapped, weights):
        return
    asked, other = actor(torch.stack([weights, swapped])).double()
    telling = seen.to(asked.device) & ((asked - other).norm(dim=-1) > _TELLING)
    if int(telling.sum()) < _LEAST_VERTICES:
        return
    normals = vertex_normals(asked, actor.neutral.faces)[telling]
    there, asked, other = (((x - asked)[telling] * normals).sum(-1) for x in (found.to(asked), asked, other))
    half = (asked - other) / 2
    side = float(((there - (asked + other) / 2) * half).sum() / half.square().sum())
    if side < _CLEARLY_OTHER:
        distances = [float((there - x).square().mean().sqrt()) for x in (asked, other)]
        raise AlignmentError(
            f"shows the other side: {distances[0]:.2g} mm (root mean square, across the skin) from what it is named "
            f"for, {distances[1]:.2g} mm from the mirror image of that (side {side:.2f} of 1 to -1); the scans are "
            "mirrored (export them in right-handed axes), or left and right are swapped in their names"
        )
