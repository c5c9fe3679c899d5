"""Texture coordinates of several tiles (UDIM) brought into the one image that a mesh has."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchface.mesh import Mesh

_MARGIN = 0.02  # of a cell's side, so that no chart's colour runs into the next


def in_one_tile(mesh: Mesh, kind: Tensor) -> Mesh:
    """A mesh whose charts all lie in [0,1] without covering each other; the same where none lies in a further tile.

    The tile of the most triangles keeps a large square of the image; all others, and what lies over it but is of
    another kind, as eyeballs over a face, have small ones along two edges.

    Args:
        mesh: any; one without texture coordinates stays as it is.
        kind: of each triangle, (F,) int64: those of different kinds have tiles of their own.
    """
    if mesh.uvs is None or mesh.uv_faces is None:
        return mesh
    uvs, corners = mesh.uvs.cpu(), mesh.uv_faces.cpu()
    tiles = uvs[corners].mean(1).floor().long()
    if not bool(tiles.any()):
        return mesh
    keys = torch.cat([tiles, kind[:, None]], dim=1)
    groups, own, counts = keys.unique(dim=0, return_inverse=True, return_counts=True)
    order = counts.argsort(descending=True)
    place = order.argsort()[own]  # 0 for the largest
    side = next(k for k in range(2, len(groups) + 2) if 2 * k - 1 >= len(groups) - 1)
    cells = [(0.0, 0.0, (side - 1) / side)]
    cells += [((side - 1) / side, row / side, 1 / side) for row in range(side)]
    cells += [(column / side, (side - 1) / side, 1 / side) for column in range(side - 1)]
    cell = torch.tensor(cells)[place]  # (F,3): left, low, side
    pairs, rows = (corners * len(groups) + own[:, None]).unique(return_inverse=True)
    face = torch.zeros(len(pairs), dtype=torch.int64)
    face[rows.flatten()] = torch.arange(len(corners)).repeat_interleave(3)
    within = (uvs[pairs // len(groups)] - tiles[face]).clamp(0, 1)
    packed = cell[face, :2] + cell[face, 2:] * (_MARGIN + (1 - 2 * _MARGIN) * within)
    return replace(mesh, uvs=packed.to(mesh.uvs), uv_faces=rows.to(mesh.uv_faces))
