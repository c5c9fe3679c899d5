"""The reprojection error of landmarks as a quadratic of weights and head motion."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.energy import Quadratic
from torchface.capture.own_rig.face_points import JAW, FacePoints
from torchface.geometry.cameras.pnp import pixel_jacobian
from torchface.geometry.rotations import rotation_matrix


@dataclass(frozen=True, eq=False)
class HeadState:
    """Where B faces stand and what they do.

    Args:
        weights: (B,N).
        rotation: rig to camera, (B,3,3).
        translation: rig to camera, (B,3), millimetres.
    """

    weights: Tensor
    rotation: Tensor
    translation: Tensor

    def moved(self, weights: Tensor, motion: Tensor) -> HeadState:
        """With other weights, turned and shifted in the camera's frame by (B,6): a rotation vector and millimetres."""
        rotation = rotation_matrix(motion[:, :3]) @ self.rotation
        return HeadState(weights, rotation, self.translation + motion[:, 3:])

    def detached(self) -> HeadState:
        return HeadState(self.weights.detach(), self.rotation.detach(), self.translation.detach())

    def motion_from(self, rotation: Tensor, translation: Tensor) -> Tensor:
        """What moves a pose (B,3,3), (B,3) here, (B,6); turns are below half a turn."""
        relative_rotation = self.rotation @ rotation.transpose(-1, -2)
        axis = 0.5 * (relative_rotation - relative_rotation.transpose(-1, -2)).flatten(1)[:, [7, 2, 3]]
        cosine = 0.5 * (relative_rotation.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1)
        sine_squared = axis.square().sum(-1, keepdim=True)
        small = sine_squared < 1e-8
        safe = torch.where(small, 0.5, sine_squared).sqrt()
        # θ/sin θ; its series where both vanish.
        factor = torch.where(small, 1 + sine_squared / 6, torch.atan2(safe, cosine) / safe)
        return torch.cat([factor * axis, self.translation - translation], dim=-1)


@dataclass(frozen=True, eq=False)
class Linearised:
    """Whitened residuals of landmarks and their derivatives.

    Args:
        residual: seen minus found, in standard deviations, (B,L,2); zero for what is not seen.
        jacobian: by the weights and the head's motion, (B,L,2,N+6).
    """

    residual: Tensor
    jacobian: Tensor

    def quadratic(self, weights: Tensor) -> Quadratic:
        r"""The linearised energy over weights and motion from here, :math:`\tfrac12 \lVert r + J (x - x_0) \rVert^2`.

        Args:
            weights: where it was linearised, (B,N).
        """
        J, r = self.jacobian.flatten(1, 2), self.residual.flatten(1)
        H = J.transpose(1, 2) @ J
        here = torch.nn.functional.pad(weights, (0, 6))
        gradient = (r[:, None] @ J)[:, 0]
        f = gradient - (H @ here[..., None])[..., 0]
        return Quadratic(H, f)


def linearise(
    points: FacePoints,
    state: HeadState,
    rows: Tensor,
    intrinsics: Tensor,
    landmarks: Tensor,
    precision: Tensor,
    along: float,
) -> Linearised:
    r"""The landmarks' errors in standard deviations, and what moves them.

    .. math:: r_l = W_l \big( \pi(K (R (b_l + B_l w) + t)) - q_l \big)

    Args:
        points: the rig's.
        state: where to linearise.
        rows: which point each landmark is, (B,68); see ``FacePoints.chosen``.
        intrinsics: K, (3,3).
        landmarks: q, (B,68,2), pixels, finite.
        precision: one over the standard deviation of each landmark, (B,68), 0 for those not seen.
        along: how much an error along the contour counts beside one across it, 0 to 1.

    Source: thesis 4.2.6, equation 40.
    """
    count, shapes = len(state.weights), points.basis.shape[-1]
    placed, basis = points.linearised(state.weights, rows)
    turned = placed @ state.rotation.transpose(-1, -2)
    pixels, by_place = pixel_jacobian(turned + state.translation[:, None], intrinsics)
    # Residuals and their derivatives by the points' places go through the same products.
    lines = torch.cat([(pixels - landmarks)[..., None], by_place], dim=-1) * precision[..., None, None]
    if along < 1:
        contour, jaw = lines[:, :JAW], pixels[:, :JAW]
        beyond = torch.cat([jaw[:, :1], jaw, jaw[:, -1:]], dim=1)
        tangent = torch.nn.functional.normalize(beyond[:, 2:] - beyond[:, :-2], dim=-1)
        squeeze = (1 - along) * tangent[..., :, None] * tangent[..., None, :]
        lines = torch.cat([contour - squeeze @ contour, lines[:, JAW:]], dim=1)
    residual, by_place = lines[..., 0], lines[..., 1:]
    by_world = (by_place.reshape(count, -1, 3) @ state.rotation).view(by_place.shape)
    by_weights = (by_world @ basis).view(count, -1, 2, shapes)
    by_turn = torch.linalg.cross(turned[:, :, None].expand_as(by_place), by_place)
    return Linearised(residual, torch.cat([by_weights, by_turn, by_place], dim=-1))
