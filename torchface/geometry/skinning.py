"""Linear blend skinning: vertices that follow joints, and the way back."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.geometry.rotations import rotation_matrix


def joint_transforms(positions: Tensor, parents: Sequence[int], rotations: Tensor) -> tuple[Tensor, Tensor]:
    r"""Where joints, turned beside their parents by vectors (B,J,3), take the space: :math:`x \mapsto A_j x + t_j`,
    (B,J,3,3) and (B,J,3). A root's parent is -1; parents come before children."""
    own = rotation_matrix(rotations.reshape(-1, 3)).reshape(*rotations.shape, 3)
    turns: list[Tensor] = []
    shifts: list[Tensor] = []
    for joint, parent in enumerate(parents):  # a head has a handful of joints
        at = positions[joint].to(own)
        turn = own[:, joint]
        shift = at - turn @ at
        if parent >= 0:
            turn, shift = turns[parent] @ turn, (turns[parent] @ shift[..., None])[..., 0] + shifts[parent]
        turns.append(turn)
        shifts.append(shift)
    return torch.stack(turns, 1), torch.stack(shifts, 1)


def skinned(vertices: Tensor, weights: Tensor, turns: Tensor, shifts: Tensor) -> Tensor:
    r"""Vertices (B,V,3) that follow joints, :math:`\sum_j w_{vj} (A_j x_v + t_j)`."""
    turn, shift = blended(weights, turns, shifts)
    return (turn @ vertices[..., None])[..., 0] + shift


def unskinned(vertices: Tensor, weights: Tensor, turns: Tensor, shifts: Tensor) -> Tensor:
    """The vertices (B,V,3) that :func:`skinned` takes to ``vertices`` (B,V,3)."""
    turn, shift = blended(weights, turns, shifts)
    return torch.linalg.solve(turn, (vertices - shift)[..., None])[..., 0]


def blended(weights: Tensor, turns: Tensor, shifts: Tensor) -> tuple[Tensor, Tensor]:
    """The transforms of each vertex, (B,V,3,3) and (B,V,3)."""
    weights = weights.to(turns)
    turn = (weights @ turns.flatten(2)).unflatten(-1, (3, 3))
    return turn, weights @ shifts
