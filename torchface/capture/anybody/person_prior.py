"""How people's landmarks differ from a rig's: by who they are, and by what finders of landmarks call by a name."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.own_rig.face_points import JAW, LANDMARKS
from torchface.errors import ShapeError

# Standard deviations of a coordinate, millimetres: finders put the contour where the head's edge is, and brows where
# hair is; eyes, nose and lips are drawn sharply.
_CONTOUR, _BROWS, _INNER = 4.0, 2.5, 1.5
_BROW_END = 27
_DEPTH = 0.4  # what a webcam sees of a displacement along its line of sight, beside one across
_GRADE = 1e-3  # how much more the first coordinate varies than the last, so that no two eigenvalues are the same


@dataclass(frozen=True, eq=False)
class PersonPrior:
    """A Gaussian of the displacement of the landmarks in head space, in D coefficients of deviation one.

    Args:
        basis: what each coefficient adds to each landmark, (68,3,D), millimetres.
        remainder: variance of a coordinate that the coefficients leave out, (68,), mm².
    """

    basis: Tensor
    remainder: Tensor

    @staticmethod
    def of(identity_modes: Tensor | None, count: int) -> PersonPrior:
        """The D likeliest ways in which landmarks differ, float64.

        Args:
            identity_modes: what a standard deviation of each of K ways of being another person adds to the landmarks,
                (K,68,3), millimetres; what finders differ by alone if absent.
            count: D, at most 204.

        Raises:
            ShapeError: not (K,68,3), or not 1 to 204 coefficients.
        """
        modes = torch.zeros(0, LANDMARKS, 3) if identity_modes is None else identity_modes.detach().cpu()
        if modes.shape[1:] != (LANDMARKS, 3) or not 1 <= count <= 3 * LANDMARKS:
            raise ShapeError(
                f"identity_modes: found {tuple(modes.shape)} and {count} coefficients, expected (K,{LANDMARKS},3) and "
                f"1 to {3 * LANDMARKS}"
            )
        rows = modes.double().flatten(1)
        deviation = torch.full((LANDMARKS,), _INNER, dtype=torch.float64)
        deviation[:JAW], deviation[JAW:_BROW_END] = _CONTOUR, _BROWS
        variance = deviation.square().repeat_interleave(3)
        covariance = rows.T @ rows + (variance * torch.linspace(1 + _GRADE, 1, len(variance)).double()).diag()
        seen = torch.tensor([1.0, 1.0, _DEPTH], dtype=torch.float64).repeat(LANDMARKS)
        values, vectors = torch.linalg.eigh(seen[:, None] * covariance * seen)
        values, vectors = values.flip(0)[:count], vectors.flip(1)[:, :count]
        # LAPACK's builds differ in a vector's sign and in vectors of one eigenvalue; a kept state means the same person
        # everywhere.
        vectors = vectors * vectors.gather(0, vectors.abs().argmax(0, keepdim=True)).sign()
        basis = vectors * values.sqrt() / seen[:, None]
        left = (covariance.diagonal() - basis.square().sum(1)).clamp(min=0)
        return PersonPrior(basis.unflatten(0, (LANDMARKS, 3)), left.unflatten(0, (LANDMARKS, 3))[:, :2].mean(1))
