"""Texture coordinates of several tiles (UDIM) brought into one image."""

import torch
from torch import Tensor

_MARGIN = 0.02  # of a cell's side, so that no chart's colour runs into the next


def in_one_tile(uvs: Tensor, uv_faces: Tensor, kind: Tensor) -> tuple[Tensor, Tensor]:
    """Charts that all lie in [0,1] without covering each other; the same where none lies in a further tile.

    The tile of the most triangles keeps a large square of the image; all others, and what lies over it but is of
    another kind, as eyeballs over a face, have small ones along two edges.

    Args:
        kind: of each triangle, (F,) int64: those of different kinds have tiles of their own.
    """
    tiles = uvs[uv_faces].mean(1).floor().long()
    if not bool(tiles.any()):
        return uvs, uv_faces
    keys = torch.cat([tiles, kind[:, None]], dim=1)
    groups, own, counts = keys.unique(dim=0, return_inverse=True, return_counts=True)
    order = counts.argsort(descending=True)
    place = order.argsort()[own]  # 0 for the largest
    side = next(k for k in range(2, len(groups) + 2) if 2 * k - 1 >= len(groups) - 1)
    cells = [(0.0, 0.0, (side - 1) / side)]
    cells += [((side - 1) / side, row / side, 1 / side) for row in range(side)]
    cells += [(column / side, (side - 1) / side, 1 / side) for column in range(side - 1)]
    cell = torch.tensor(cells)[place]  # (F,3): left, low, side
    pairs, rows = (uv_faces * len(groups) + own[:, None]).unique(return_inverse=True)
    face = torch.zeros(len(pairs), dtype=torch.int64)
    face[rows.flatten()] = torch.arange(len(uv_faces)).repeat_interleave(3)
    within = (uvs[pairs // len(groups)] - tiles[face]).clamp(0, 1)
    packed = cell[face, :2] + cell[face, 2:] * (_MARGIN + (1 - 2 * _MARGIN) * within)
    return packed.to(uvs), rows
