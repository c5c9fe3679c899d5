"""Example poses of a character beside what learned rules give."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.rendering.compositing import caption, sheet
from torchface.rig import BlendshapeRig
from torchface.viz.figures.face_views import FRONT, clay_colors, face_views

_COLUMNS, _MOST, _WIDTH, _HEIGHT = 6, 24, 200, 250


def pose_pairs(rig: BlendshapeRig, names: Sequence[str], wanted: Tensor, found: Tensor) -> Tensor:
    """A column a pose: as an animator set it above, as the rules give it below; (3,H,W), 24 poses at most.

    Args:
        rig: the character, N shapes.
        names: of the P poses.
        wanted, found: weights, (P,N).
    """
    colors = clay_colors(rig.neutral)

    def view(weights: Tensor, text: str) -> Tensor:
        with torch.no_grad():
            mesh = rig.neutral.with_vertices(rig(weights[None])[0])
        drawn = face_views(mesh, (FRONT,), colors, _WIDTH, _HEIGHT, samples=1, framed_by=rig.neutral)
        return caption(drawn, text, 13)

    pairs = []
    for name, given, learned in zip(names[:_MOST], wanted, found, strict=False):
        off = float((given - learned).abs().max())
        pairs.append(sheet([view(given, name[:26]), view(learned, f"learned, off by {off:.2f}")], 1))
    return sheet(pairs, min(_COLUMNS, len(pairs)))
