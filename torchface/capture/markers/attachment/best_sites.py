r"""The best site of a marker on a moving surface: where the surface stays nearest to it over a whole take.

A point fixed to triangle T with barycentric coordinates :math:`b` follows :math:`\sum_k b_k A_k \tilde w_t` with
:math:`\tilde w_t = (1, w_t)`. Its squared distance to a marker's path :math:`y_t`, summed over the frames in which the
marker was seen, needs the take only through moments:

.. math:: C = \sum_t \tilde w_t \tilde w_t^\top, \qquad G = \sum_t y_t \tilde w_t^\top.

With :math:`C = LL^\top` it is a squared distance in a space of :math:`3(N+1)` dimensions, between
:math:`\sum_k b_k A_k L` and :math:`G L^{-\top}`, up to what no site can change. The best site of a triangle is
the point of that triangle, in that space, nearest to the marker.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.meshes.surface_index import triangle_coordinates

# Where few weights move, C is singular; a ten-thousandth of a weight a frame changes no distance that counts.
_MIN_MOMENT = 1e-8


@dataclass(frozen=True, eq=False)
class PathMoments:
    """The moments of a take that the site search needs."""

    factor: Tensor  # L, (N+1,N+1)
    path: Tensor  # G L^{-T}, (M,3,N+1)
    residual: Tensor  # squared distance that no site can change, (M,), mm²
    frames: Tensor  # in how many frames each marker was seen, (M,)

    @staticmethod
    def of(
        paths: Tensor,
        weights: Tensor,
        on_rig: Tensor | None = None,
        initial: Tensor | None = None,
        prior_weight: float = 0.0,
    ) -> "PathMoments":
        """Of markers (T,M,3), NaN where not seen, and extended weights (T,N+1), float64.

        The initial guess of the sites at rest, ``initial`` (M,3), counts as ``prior_weight`` frames at rest.

        A marker that is not seen is put where its present site is (``on_rig``, (T,M,3)). That keeps one C for all
        markers and moves no site that is the best already; others take a few more iterations.
        """
        seen = ~torch.isnan(paths[..., 0])
        if on_rig is not None:
            paths = torch.where(seen[..., None], paths, on_rig)
        if initial is not None:
            paths = torch.cat([paths, prior_weight**0.5 * initial[None]])
            rest = torch.zeros_like(weights[:1])
            rest[:, 0] = prior_weight**0.5
            weights = torch.cat([weights, rest])
        moments = weights.T @ weights
        moments.diagonal().add_(_MIN_MOMENT * len(paths))
        factor = torch.linalg.cholesky(moments)
        cross = paths.flatten(1).T @ weights
        path = torch.linalg.solve_triangular(factor, cross.T, upper=False).T.unflatten(0, (-1, 3))
        residual = paths.square().sum((0, 2)) - path.square().sum((1, 2))
        return PathMoments(factor, path, residual.clamp(min=0), seen.sum(0).to(weights))


@dataclass(frozen=True, eq=False)
class Sites:
    """The best sites."""

    triangles: Tensor  # rows of the faces, (M,) int64
    barycentric: Tensor  # (M,3), float64
    error: Tensor  # root mean square distance to the marker's path, (M,), millimetres


def best_sites(points: Tensor, faces: Tensor, candidates: Tensor, moments: PathMoments) -> Sites:
    """The best site of each marker among the points of its candidate triangles, rows (M,Q) of ``faces``, exact, by
    the affine maps (V,3,N+1) of the vertices. Source: thesis 4.1.2, algorithm 4, steps 4 and 5."""
    used, local = faces[candidates].unique(return_inverse=True)
    corner = (points[used] @ moments.factor).flatten(1)[local]
    corner[:, :, 1:] -= corner[:, :, :1]
    corner[:, :, 0] -= moments.path.flatten(1)[:, None]
    gram = corner @ corner.mT  # of pa, ab and ac, half the time of six sums
    ap2, ab2, ac2 = gram.diagonal(dim1=-2, dim2=-1).unbind(-1)
    d1, d2, abac = -gram[..., 0, 1], -gram[..., 0, 2], gram[..., 1, 2]
    v, w = triangle_coordinates(ab2, ac2, abac, d1, d2)
    squared = ap2 - 2 * (v * d1 + w * d2) + v * v * ab2 + w * w * ac2 + 2 * v * w * abac
    best = squared.argmin(1, keepdim=True)
    v, w, squared, triangles = (part.gather(1, best)[:, 0] for part in (v, w, squared, candidates))
    error = ((squared.clamp(min=0) + moments.residual) / moments.frames.clamp(min=1)).sqrt()
    return Sites(triangles, torch.stack([1 - v - w, v, w], dim=1), error)
