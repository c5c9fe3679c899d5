"""Points of a rig's surface that a dense landmark network finds, beside the 68 landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchface.attachment import Attachment
from torchface.capture.own_rig.face_points import EYE_CORNERS, LANDMARKS
from torchface.capture.own_rig.gauss_newton import ErrorModes, HeadState, Linearised
from torchface.correctives.activation import CorrectiveActivation
from torchface.geometry.cameras.pnp import pixel_jacobian
from torchface.geometry.meshes.operators import vertex_normals
from torchface.optim.exported_operators import symmetric_inverse
from torchface.rig import BlendshapeRig

# Cosines of the surface's turn from the camera: below the first a point does not count, above the second fully.
_EDGE_ON, _FACING = 0.17, 0.42
_ALIKE_OVER = 1 / 3  # of the eyes' distance
_MODES = 24  # of a face: its area over that of 30 mm, and some


@dataclass(frozen=True, eq=False)
class FaceSurfacePoints:
    """P points of a surface that follow N weights.

    Args:
        rest: (P,3), millimetres.
        basis: what a unit of each weight adds, (P,3,N); normal equations are in its precision.
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

    def linearised(self, head: HeadState, intrinsics: Tensor, found: Tensor, precision: Tensor) -> Linearised:
        """The points' errors in standard deviations, and what moves them, at a state of B faces.

        Args:
            head: the state.
            intrinsics: K, (3,3).
            found: pixels (B,P,2), finite.
            precision: one over the deviations, (B,P), 0 for points not seen.
        """
        basis, near = self.basis, head.weights.to(self.basis)
        placed = self.rest + (near @ basis.flatten(0, 1).T).unflatten(1, self.rest.shape)
        if self.activation is not None and self.corrective_basis is not None:
            more = self.corrective_basis.flatten(0, 1)
            placed = placed + (self.activation(head.weights) @ more.T).unflatten(1, self.rest.shape)
            basis = basis + (more @ self.activation.jacobian(head.weights)).unflatten(1, self.rest.shape).to(basis)
        turned = placed @ head.rotation.transpose(-1, -2)
        at, by_place = pixel_jacobian(turned + head.translation[:, None], intrinsics)
        by_place = by_place * precision[..., None, None]
        by_world = (by_place.flatten(1, 2) @ head.rotation).view(by_place.shape)
        by_turn = torch.linalg.cross(turned[:, :, None].expand_as(by_place), by_place)
        lines = by_world.to(basis)[..., None]
        # Thousands of products of a 2x3 and a 3xN matrix: three sums over all of them are quicker.
        x, y, z = (lines[..., axis, :] * basis[..., axis, :].unsqueeze(-2) for axis in range(3))
        by_weights = x + y + z
        jacobian = torch.cat([by_weights, by_turn.to(basis), by_place.to(basis)], dim=-1)
        return Linearised(((at - found) * precision[..., None]).to(basis), jacobian)


def smooth_modes(places: Tensor, length: float) -> Tensor:
    r"""The leading modes of errors that are alike over a length, of L places (L,3): (L,M), each place's variance 1.

    :math:`K_{lm} K_{mm}^{-1/2}` of the kernel :math:`\exp(-d^2 / 2 \ell^2)` and M places that are as far apart as
    places can be.

    Source: Williams and Seeger 2001 (Nyström).
    """
    places = places.detach().double()
    chosen, far = [0], (places - places[0]).norm(dim=1)
    while len(chosen) < min(_MODES, len(places)) and float(far.max()) > 0.3 * length:
        chosen.append(int(far.argmax()))
        far = torch.minimum(far, (places - places[chosen[-1]]).norm(dim=1))
    apart = torch.cdist(places, places[chosen])
    kernel = torch.exp(-0.5 * (apart / length).square())
    values, vectors = torch.linalg.eigh(kernel[chosen] + 1e-6 * torch.eye(len(chosen), dtype=torch.float64))
    return kernel @ (vectors * values.rsqrt())


def alike_over(places: Tensor) -> float:
    """Over what length errors are alike, millimetres, of places (68+P,3) whose first are the landmarks."""
    right, left = (places[i] for i in EYE_CORNERS)
    return _ALIKE_OVER * max(float((right - left).norm()), 1.0)


def alike_errors(modes: Tensor, counts: Tensor) -> tuple[Tensor, ErrorModes]:
    """The independent share of each deviation, (B,68+P), and what errors have in common; nothing without a point.

    Args:
        modes: of the landmarks' and the points' errors, (68+P,M).
        counts: root of what each of them counts, (B,68+P).
    """
    shown = (counts[:, LANDMARKS:] > 0).any(1)
    modes = modes * shown.to(counts)[:, None, None]
    own = (1 - modes.square().sum(-1)).clamp(min=1e-3).sqrt()
    scaled = counts[..., None] * modes / own[..., None]
    identity = torch.eye(modes.shape[-1], dtype=modes.dtype, device=modes.device)
    inner = identity + scaled.transpose(1, 2) @ scaled
    return own, ErrorModes(scaled, torch.stack([symmetric_inverse(one) for one in inner]))
