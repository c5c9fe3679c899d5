"""What the webcam's solve looks up of a rig: names, the landmark each point follows, lids' ways, what tells of what."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.capture.own_rig.face_points import JAW, LANDMARKS, FacePoints
from torchface.capture.own_rig.landmark_offsets import lid_pairs
from torchface.shape_names import ARKIT, mapping

CONTOUR_TRUST = 0.5
"""How much a landmark of the contour counts beside an inner one."""


def arkit_names(names: Sequence[str]) -> list[str]:
    """What ARKit calls each shape; its own name where ARKit knows none."""
    called = mapping(names, ARKIT)
    return [
        ARKIT[int(column.argmax())] if bool(column.any()) else name
        for name, column in zip(names, called.T, strict=True)
    ]


def owners(points: FacePoints) -> Tensor:
    """The landmark whose displacement each point takes, (P,): those of a contour landmark's curve take its."""
    owner = torch.arange(len(points.rest))
    for landmark, (row, valid) in enumerate(zip(points.rows, points.valid, strict=True)):  # curves have own lengths
        owner[row[valid]] = landmark
    return owner


def closing(basis: Tensor, names: Sequence[str]) -> tuple[Tensor, Tensor]:
    """What displacements (68,3,D) take of the lids' way as an eye shuts, (2,68,3,D); the shapes that shut, (2,N)."""
    made, shapes = torch.zeros(2, *basis.shape, dtype=basis.dtype), torch.zeros(2, len(names), dtype=basis.dtype)
    for upper, lower, closing in lid_pairs(names):
        eye = 0 if upper < 42 else 1
        apart = 0.5 * (basis[upper] - basis[lower])
        made[eye, upper], made[eye, lower], shapes[eye] = apart, -apart, closing.double()
    return made, shapes


def tells(points: FacePoints) -> Tensor:
    """How much of what could tell of each shape each landmark is, (68,N)."""
    moved = points.basis[:LANDMARKS].square().sum(1)
    moved[:JAW] *= CONTOUR_TRUST
    return moved / moved.sum(0).clamp(min=1e-6)
