"""Examples made without a person: a rig's shapes as a camera before it sees their landmarks."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.capture.anybody.examples.example_expressions import (
    NEUTRAL,
    ExampleExpression,
    character_matrix,
    paper_expressions,
)
from torchface.capture.anybody.examples.example_shapes import ExampleShapes
from torchface.errors import NameMismatchError, ShapeError
from torchface.geometry.rotations import rotation_matrix
from torchface.rig import BlendshapeRig

SIDE = 600
"""Pixels a side of the picture that the examples are seen in, the paper's; the face fills half of its height."""

_DISTANCE = 600.0  # millimetres from the camera to the face, as one sits before a webcam
_NECK = (0.0, -60.0, -90.0)  # millimetres from between the eyes to where a head turns about


def rig_examples(rig: BlendshapeRig, names: Sequence[str] | None = None) -> ExampleShapes:
    """A rig's own shapes as examples, and after them the four of the paper that turn and tilt the head.

    Args:
        rig: with its 68 landmarks annotated, unless they are given.
        names: of the shapes to take; all that move a landmark by more than rounding if absent.

    Raises:
        NameMismatchError: the rig lacks a shape.
        ShapeError: there are no 68 landmarks.

    Example:
        >>> from torchface.synthetic import performer
        >>> rig_examples(performer(texture=False), ["jawOpen", "browInnerUp"]).names
        ('jawOpen', 'browInnerUp', 'rotate_left', 'rotate_right', 'tilt_left', 'tilt_right')
    """
    marks = _marks(rig)
    moves = rig.deltas[:, marks].norm(dim=-1).amax(1) > 1e-4
    taken = [name for name, seen in zip(rig.names, moves.tolist(), strict=True) if seen] if names is None else names
    if not taken:
        raise NameMismatchError("rig: found no shape that moves a landmark, expected some")
    rows = rig.index(taken)
    weights = torch.eye(len(rig.names), dtype=rig.deltas.dtype, device=rig.deltas.device)[rows]
    turns = [expression for expression in paper_expressions() if expression.yaw or expression.roll]
    poses = [*(ExampleExpression(name, "", {}, 0.0, 0.0) for name in taken), *turns]
    return _examples(rig, marks, poses, torch.cat([weights, weights.new_zeros(len(turns), len(rig.names))]))


def paper_examples(rig: BlendshapeRig) -> ExampleShapes:
    """The paper's 15 expressions, in its order, as a rig with ARKit's shapes shows them.

    Args:
        rig: with its 68 landmarks annotated, unless they are given.

    Raises:
        NameMismatchError: the rig has no shape that one of the expressions means.
        ShapeError: there are no 68 landmarks.

    Example:
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> len(examples.names), examples.names[0]
        (15, 'brow_lower_left')
    """
    marks = _marks(rig)
    shown = [expression for expression in paper_expressions() if expression.name != NEUTRAL]
    weights = character_matrix([one.name for one in shown], rig.names).to(rig.deltas).T.clamp(0, 1)
    still = [one.name for one, row in zip(shown, weights, strict=True) if one.shapes and not bool(row.any())]
    if still:
        raise NameMismatchError(
            f"rig: found no shape for {', '.join(still)} among {', '.join(rig.names[:5])}, ...; expected ARKit's names"
        )
    return _examples(rig, marks, shown, weights)


def _marks(rig: BlendshapeRig) -> Tensor:
    annotations = rig.neutral.annotations
    marks = None if annotations is None else annotations.landmarks
    if marks is None or marks.shape != (68,):
        found = "no landmarks" if marks is None else f"{tuple(marks.shape)}"
        raise ShapeError(f"rig: found {found}, expected the 68 of iBUG annotated: torchface pick")
    return marks.long().to(rig.vertices.device)


def _examples(rig: BlendshapeRig, marks: Tensor, shown: Sequence[ExampleExpression], weights: Tensor) -> ExampleShapes:
    neutral = rig.vertices[marks].double()
    moved = torch.einsum("bn,npc->bpc", weights.double(), rig.deltas[:, marks].double())
    points = torch.cat([neutral[None], neutral + moved])
    angles = [(0.0, 0.0), *((one.yaw, one.roll) for one in shown)]
    pivot = neutral[[36, 39, 42, 45]].mean(0) + neutral.new_tensor(_NECK)
    turned = torch.stack([_turn(yaw, roll).to(neutral) for yaw, roll in angles])
    points = (points - pivot) @ turned.transpose(1, 2) + pivot
    seen = _project(points, neutral)
    return ExampleShapes(tuple(one.name for one in shown), seen[0].float(), seen[1:].float())


def _turn(yaw: float, roll: float) -> Tensor:
    """Toward the person's left, the viewer's right; the crown toward the person's left shoulder."""
    about = torch.tensor([[0.0, math.radians(yaw), 0.0], [0.0, 0.0, -math.radians(roll)]], dtype=torch.float64)
    first, second = rotation_matrix(about)
    return second @ first


def _project(points: Tensor, neutral: Tensor) -> Tensor:
    """Pixels (B,68,2) of points (B,68,3) before a camera that sees the neutral (68,3) from the front."""
    low, high = neutral.amin(0), neutral.amax(0)
    middle = (low + high) / 2
    away = _DISTANCE - (points[..., 2:] - middle[2])
    focal = 0.5 * SIDE * _DISTANCE / float(high[1] - low[1])
    across = (points[..., :2] - middle[:2]) * points.new_tensor([1.0, -1.0])
    return focal * across / away + (SIDE - 1) / 2
