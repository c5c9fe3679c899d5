"""Points of a rig's surface that a dense landmark network finds, beside the 68 landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchface.attachment import Attachment
from torchface.capture.energy import Quadratic
from torchface.correctives.activation import CorrectiveActivation
from torchface.geometry.cameras.pnp import pixel_jacobian
from torchface.geometry.meshes.operators import vertex_normals
from torchface.rig import BlendshapeRig

# Cosines of the surface's turn from the camera: below the first a point does not count, above the second fully.
_EDGE_ON, _FACING = 0.17, 0.42


@dataclass(frozen=True, eq=False)
class FaceSurfacePoints:
    """P points of a surface that follow N weights.

    Args:
        rest: (P,3), millimetres.
        basis: what a unit of each weight adds, (P,3,N).
        normals: outward, of the face at rest, (P,3).
        activation, corrective_basis: of C correctives, and what a unit of each adds, (P,3,C); none if absent.
    """

    rest: Tensor
    basis: Tensor
    normals: Tensor
    activation: CorrectiveActivation | None = None
    corrective_basis: Tensor | None = None

    @staticmethod
    def of(rig: BlendshapeRig, sites: Attachment) -> FaceSurfacePoints:
        """Those of a rig at sites on its neutral mesh, float64."""
        faces, vertices = rig.neutral.faces, rig.vertices.detach().double()
        basis = sites.on(faces, rig.deltas.detach().double()).permute(1, 2, 0).contiguous()
        normals = normalize(sites.on(faces, vertex_normals(vertices, faces)), dim=-1)
        more = None
        if rig.correctives is not None:
            more = sites.on(faces, rig.correctives.deltas.detach().double()).permute(1, 2, 0).contiguous()
        return FaceSurfacePoints(sites.on(faces, vertices), basis, normals, rig.activation, more)

    def facing(self, rotation: Tensor, translation: Tensor) -> Tensor:
        """How far each point faces the camera of poses (B,3,3), (B,3): (B,P), from 0 edge-on and beyond to 1."""
        ahead = -normalize(self.rest @ rotation.transpose(-1, -2) + translation[:, None], dim=-1)
        cosine = (ahead * (self.normals @ rotation.transpose(-1, -2))).sum(-1)
        return ((cosine - _EDGE_ON) / (_FACING - _EDGE_ON)).clamp(0, 1)

    def energy(
        self, weights: Tensor, rotation: Tensor, translation: Tensor, intrinsics: Tensor, found: tuple[Tensor, Tensor]
    ) -> Quadratic:
        r"""Half the squared errors of the points' projections in standard deviations, of a step (B,N+6) from a state.

        The normal equations :math:`\sum_p J_p^\top W_p J_p` alone are kept.

        Args:
            weights, rotation, translation: the state, (B,N), (B,3,3), (B,3).
            intrinsics: K, (3,3).
            found: pixels (B,P,2), finite, and one over their standard deviations, (B,P), 0 for those not seen.
        """
        pixels, precision = found
        placed = self.rest + (weights @ self.basis.flatten(0, 1).T).unflatten(1, self.rest.shape)
        basis = self.basis.flatten(0, 1).unflatten(0, self.rest.shape)
        if self.activation is not None and self.corrective_basis is not None:
            more = self.corrective_basis.flatten(0, 1)
            placed = placed + (self.activation(weights) @ more.T).unflatten(1, self.rest.shape)
            basis = basis + (more @ self.activation.jacobian(weights)).unflatten(1, self.rest.shape)
        turned = placed @ rotation.transpose(-1, -2)
        at, by_place = pixel_jacobian(turned + translation[:, None], intrinsics)
        by_place = by_place * precision[..., None, None]
        residual = (at - pixels) * precision[..., None]
        by_world = (by_place.flatten(1, 2) @ rotation).view(by_place.shape)
        by_weights = by_world @ basis
        by_turn = torch.linalg.cross(turned[:, :, None].expand_as(by_place), by_place)
        J = torch.cat([by_weights, by_turn, by_place], dim=-1).flatten(1, 2)
        return Quadratic(J.transpose(1, 2) @ J, (residual.flatten(1)[:, None] @ J)[:, 0])
