"""Points of the surface on people: what the coefficients of a person's landmarks say of them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from torchface.attachment import Attachment
from torchface.capture.anybody.person_landmarks import VISIBLE, PersonLandmarks
from torchface.capture.own_rig.face_points import LANDMARKS
from torchface.capture.own_rig.surface_points import FaceSurfacePoints, alike_over, smooth_modes
from torchface.errors import ShapeError
from torchface.rig import BlendshapeRig

_OWN = 0.7  # millimetres: what points on people lie off by beside all modes of identity


class PersonSurface(nn.Module):
    r"""P points of a rig's surface on people whose landmarks are known by their D coefficients z, float64.

    Landmarks and points differ together from person to person: :math:`E(y | z) = \operatorname{Cov}(y, z) z`, and what
    that leaves adds to the points' variance. So a person is learned from the landmarks alone.

    Args:
        rig: N shapes.
        sites: where the points lie on its neutral mesh.
        identity_modes: what a standard deviation of each of K ways to be another adds to landmarks and points,
            (K,68+P,3), millimetres; none if absent.
        person: the landmarks, of the same modes.
        alike: share of the errors' variance that neighbours have in common.

    Raises:
        ShapeError: the modes are of other points.
    """

    rest: Tensor
    basis: Tensor
    normals: Tensor
    person_basis: Tensor
    remainder: Tensor
    modes: Tensor

    def __init__(
        self,
        rig: BlendshapeRig,
        sites: Attachment,
        identity_modes: Tensor | None,
        person: PersonLandmarks,
        alike: float,
    ) -> None:
        super().__init__()
        points = FaceSurfacePoints.of(rig.linear("WebcamSolver"), sites)
        count, coefficients = len(points.rest), person.person_basis.shape[-1]
        modes = torch.zeros(0, LANDMARKS + count, 3) if identity_modes is None else identity_modes
        if modes.shape[1:] != (LANDMARKS + count, 3):
            raise ShapeError(f"identity_modes: found {tuple(modes.shape)}, expected (K,{LANDMARKS + count},3)")
        rows = modes.double()
        landmarks, own = rows[:, :LANDMARKS].flatten(1), rows[:, LANDMARKS:].flatten(1)
        # The coefficients are the landmarks' displacements along directions of unit variance.
        visible = torch.tensor(VISIBLE, dtype=torch.float64).repeat(LANDMARKS)
        along = visible[:, None] * person.person_basis.reshape(-1, coefficients)
        to_coefficients = visible[:, None] * along / along.square().sum(0)
        person_basis = own.T @ (landmarks @ to_coefficients)
        left = (own.square().sum(0) - person_basis.square().sum(1)).clamp(min=0).view(count, 3)
        places = torch.cat([person.rest[:LANDMARKS], points.rest])
        for name, value in {
            "rest": points.rest,
            "basis": points.basis.float(),
            "normals": points.normals,
            "person_basis": person_basis.view(count, 3, coefficients),
            "remainder": left[:, :2].mean(1) + _OWN**2,
            "modes": alike**0.5 * smooth_modes(places, alike_over(places)),
        }.items():
            self.register_buffer(name, value)

    def points(self, person: Tensor) -> FaceSurfacePoints:
        """The points on a person of coefficients (D,)."""
        rig = FaceSurfacePoints(self.rest, self.basis, self.normals)
        return replace(rig, rest=self.rest + self.person_basis @ person)
