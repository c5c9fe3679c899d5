r"""The curvature of a take's squared marker distances in sites, pose and all weights together.

To first order a marker's distance to its site becomes :math:`r_{tm} - K_{tm} \theta - B_m d_t`, with :math:`\theta` the
steps of all sites along the skin and of the pose, and :math:`d_t` the change of frame t's weights. The weights are
eliminated frame by frame:

.. math::
    S = \sum_t K_t^\top K_t - C_t^\top G_t^{-1} C_t, \qquad C_t = B^\top K_t, \quad G_t = B^\top B + \varepsilon I

S is the curvature in :math:`\theta` alone: directions in which it is small are those that the take does not determine.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.markers.helmet_motion import rigid_columns
from torchface.capture.markers.surface_motion import with_one
from torchface.geometry.similarity import Similarity

_AT_BOUND = 1e-6
_FREE_RIDGE = 1e-4
# Rotations and the scale are scaled to the motion of a point this far from the middle, in mm, as the sites are.
ARM = 50.0


@dataclass(frozen=True, eq=False)
class SitesOnTake:
    """Sites, pose and weights of a take's frames, and how the markers move with them."""

    affine: Tensor  # affine maps of the sites, (M,3,N+1), millimetres
    tangents: Tensor  # affine maps of two unit tangents of the skin at each site, (M,2,3,N+1)
    moved: Tensor  # markers in rig space, (T,M,3), NaN where not seen
    weights: Tensor  # (T,N)
    pose_columns: Tensor  # how a unit of each pose parameter moves each marker, (T,M,3,G)
    slips: bool = False  # six columns of rigid motion a frame follow the weights


@dataclass(frozen=True, eq=False)
class TakeCurvature:
    """Second order of half the squared distance over the given frames, in mm²."""

    information: Tensor  # S, (2M+G,2M+G): two tangents of each site, then G columns of the pose
    gradient: Tensor  # of them, (2M+G,)
    factor: Tensor  # Cholesky factors of G_t, (T,N,N); rows of weights in the active set are those of the identity
    cross: Tensor  # C_t, (T,N,2M+G)
    weight_gradient: Tensor  # (T,N)

    @staticmethod
    def of(fit: SitesOnTake, ridge: float, bounded: bool = True) -> "TakeCurvature":
        """At sites, pose and weights; those at 0 or 1 are in the active set if ``bounded``."""
        affine, moved, weights, slips = fit.affine, fit.moved, fit.weights, fit.slips
        markers, frames = len(affine), len(moved)
        rest, basis = affine[..., 0], affine[..., 1:]
        extended = with_one(weights)
        seen = ~torch.isnan(moved).any(-1)
        shown = seen[..., None, None].double()
        residual = torch.where(seen[..., None], moved - torch.einsum("mcn,tn->tmc", affine, extended), 0.0)
        free = (weights > _AT_BOUND) & (weights < 1 - _AT_BOUND) if bounded else torch.ones_like(weights).bool()
        ridges = affine.new_full((basis.shape[2],), ridge)
        weight_gradient = torch.einsum("mcn,tmc->tn", basis, residual) - ridge * markers * weights
        if slips:
            rigid = rigid_columns(rest, rest.mean(0))
            basis = torch.cat([basis, rigid], dim=2)
            ridges = torch.cat([ridges, ridges.new_full((6,), _FREE_RIDGE)])
            free = torch.cat([free, free.new_ones(frames, 6)], dim=1)
            weight_gradient = torch.cat([weight_gradient, torch.einsum("mcn,tmc->tn", rigid, residual)], dim=1)
        site_motion = torch.einsum("mkcn,tn->tmck", fit.tangents, extended) * shown
        columns = -fit.pose_columns * shown

        size, poses = 2 * markers, fit.pose_columns.shape[-1]
        information = affine.new_zeros(size + poses, size + poses)
        row = torch.arange(markers)
        sites = affine.new_zeros(markers, 2, markers, 2)
        sites[row, :, row] = torch.einsum("tmci,tmcj->mij", site_motion, site_motion)
        information[:size, :size] = sites.reshape(size, size)
        between = torch.einsum("tmci,tmcg->mig", site_motion, columns).reshape(size, poses)
        information[:size, size:], information[size:, :size] = between, between.T
        information[size:, size:] = torch.einsum("tmcg,tmch->gh", columns, columns)

        own = (basis.transpose(1, 2) @ basis).flatten(1)
        hessian = (seen.double() @ own).unflatten(1, (basis.shape[2], -1)) + torch.diag(ridges * markers)
        active = torch.diag_embed((~free).double())
        factor = torch.linalg.cholesky(hessian * free[:, :, None] * free[:, None] + active)
        to_sites = torch.einsum("mcn,tmck->tnmk", basis, site_motion).flatten(2)
        cross = torch.cat([to_sites, torch.einsum("mcn,tmcg->tng", basis, columns)], dim=2) * free[..., None]
        weight_gradient = weight_gradient * free
        half = torch.linalg.solve_triangular(factor, cross, upper=False).flatten(0, 1)
        information = information - half.T @ half
        total = torch.cat(
            [
                torch.einsum("tmck,tmc->mk", site_motion, residual).flatten(),
                torch.einsum("tmcg,tmc->g", columns, residual),
            ]
        )
        weight_step = torch.cholesky_solve(weight_gradient[..., None], factor)[..., 0]
        return TakeCurvature(
            information, total - torch.einsum("tnp,tn->p", cross, weight_step), factor, cross, weight_gradient
        )

    def step(self, precision: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """A Newton step of sites and pose (2M+G,), with a prior's ``precision`` (2M+G,), and the change of the
        weights (T,N)."""
        step = torch.linalg.solve(self.information + torch.diag(precision), self.gradient + gradient)
        return step, torch.cholesky_solve((self.weight_gradient - self.cross @ step)[..., None], self.factor)[..., 0]


def pose_columns(on_rig: Tensor, pose: Similarity) -> Tensor:
    """The derivative of markers at points (T,M,3) in the pose: (T,M,3,G).

    One pose: translations along the axes, rotations about them and the scale, about the mean of all points.
    A pose a frame: the scale alone, about each frame's mean; its motion is among what ``TakeCurvature`` eliminates.
    """
    if len(pose.scale) > 1:
        return ((on_rig - on_rig.mean(1, keepdim=True)) / ARM)[..., None]
    arm = (on_rig - on_rig.mean((0, 1))) / ARM
    axes = torch.eye(3, dtype=on_rig.dtype).expand(*on_rig.shape, 3)
    rotations = torch.linalg.cross(axes, arm[..., None, :].expand_as(axes), dim=-1).transpose(2, 3)
    return torch.cat([axes, rotations, arm[..., None]], dim=3)
