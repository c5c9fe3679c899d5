"""Triangles that a registration has turned over, turned back by moving as little as can be around them."""

import torch
from torch import Tensor

from torchface.geometry.meshes.deformation import degenerate_triangles
from torchface.geometry.meshes.operators import components, triangle_cross
from torchface.geometry.similarity import similarity_transform

_MAX_CIRCLES = 6
_AROUND = 2
_STIFF = 0.2
_FLAT = 1e-9  # the area over the square of the longest edge that is rounding alone


def turned_over(rest: Tensor, current: Tensor, faces: Tensor) -> Tensor:
    """Mask (F,) of the triangles whose normal has turned by more than 90° since rest.

    A triangle without area has no normal that could turn, only rounding that differs from processor to processor.
    """
    turned = (triangle_cross(current, faces) * triangle_cross(rest, faces)).sum(-1) < 0
    rows = turned.nonzero()[:, 0]
    flat = degenerate_triangles(rest, faces[rows], _FLAT) | degenerate_triangles(current, faces[rows], _FLAT)
    return turned.index_fill(0, rows[flat], False)


def unfolded(rest: Tensor, current: Tensor, faces: Tensor) -> Tensor:
    """Positions (V,3) without triangles that have turned over, or with fewer of them.

    The corners of such triangles go to where an affine map, fitted to what lies around them, sends their places at
    rest; in widening circles, until nothing is turned over. A sliver turns for a hundredth of a millimetre.
    """
    best, min_count = current, int(turned_over(rest, current, faces).sum())
    for circle in range(_MAX_CIRCLES):
        folded = turned_over(rest, best, faces)
        if not folded.any():
            break
        inside = torch.zeros(len(rest), dtype=torch.bool)
        inside[faces[folded].flatten()] = True
        inside = grown(inside, faces, circle)
        label = components(faces[inside[faces].all(-1)], len(rest))
        moved = best.clone()
        for patch in label[inside].unique():  # a patch a turn: they are a few
            own = inside & (label == patch)
            around = grown(own, faces, _AROUND) & ~inside
            if int(around.sum()) >= 4:
                moved[own] = _by_neighbours(rest[own], rest[around], best[around])
        left = int(turned_over(rest, moved, faces).sum())
        if left < min_count:
            best, min_count = moved, left
    return best


def grown(mask: Tensor, faces: Tensor, rings: int = 1) -> Tensor:
    """A mask (V,) with so many rings of triangles around it."""
    mask = mask.clone()
    for _ in range(rings):
        mask[faces[mask[faces].any(-1)].flatten()] = True
    return mask


def _by_neighbours(points: Tensor, rest: Tensor, current: Tensor) -> Tensor:
    """Where the affine map that sends the neighbours (N,3) from rest to current sends points.

    A ring of neighbours may lie in a plane and says nothing of what is across it: there their similarity does.
    """
    pose = similarity_transform(rest[None], current[None])
    own, there = rest - rest.mean(0), current - current.mean(0)
    gram = own.T @ own
    stiff = _STIFF * float(gram.trace()) / 3 * torch.eye(3, dtype=rest.dtype)
    alike = pose.scale.to(rest) * pose.rotation[0].to(rest)
    linear = torch.linalg.solve(gram + stiff, own.T @ there + stiff @ alike.T)
    return current.mean(0) + (points - rest.mean(0)) @ linear
