"""A person's landmarks beside a rig's: how people and finders differ, the rig's points on a person, learning them."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from torchface.capture.energy import Quadratic
from torchface.capture.own_rig.face_points import JAW, LANDMARKS, FacePoints, make_room_for_points
from torchface.capture.own_rig.gauss_newton import HeadState, Linearised
from torchface.capture.own_rig.landmark_offsets import lid_pairs
from torchface.errors import ShapeError
from torchface.optim.exported_operators import symmetric_inverse
from torchface.rig import BlendshapeRig

# Standard deviations of a coordinate, millimetres: finders put the contour where the head's edge is, and brows where
# hair is; eyes, nose and lips are drawn sharply.
_CONTOUR, _BROWS, _INNER = 4.0, 2.5, 1.5
_BROW_END = 27
VISIBLE = (1.0, 1.0, 0.4)
"""What a webcam sees of a displacement beside one across: of one along its line of sight less."""
_GRADE = 1e-3  # how much more the first coordinate varies than the last, so that no two eigenvalues are the same
_LEFT_EYE = 42  # the first of its landmarks
_POSE_INFORMATION = 1e-6
_SOFTENING = 0.1
_READINGS = 5.0  # how much what was read of a frame counts here, beside one of its readings: as in a take's offsets
_RESTING = 100.0  # how much surer rest is of somebody who has been asked to rest


class PersonLandmarks(nn.Module):
    r"""A rig's points on people, whose landmarks lie beside the rig's by a Gaussian in D coefficients, float64.

    Identity and the finder's habits are one, :math:`z \sim N(0, I)`.

    Args:
        rig: N shapes with the 68 landmarks annotated.
        identity_modes: what a standard deviation of each of K ways of being another person adds to the landmarks,
            (K,68,3), millimetres; what finders differ by alone if absent.
        coefficients: D, at most 204.
    """

    rest: Tensor
    basis: Tensor
    rows: Tensor
    valid: Tensor
    side: Tensor
    owner: Tensor
    person_basis: Tensor
    person_remainder: Tensor
    closing_basis: Tensor
    closing_shapes: Tensor

    def __init__(self, rig: BlendshapeRig, identity_modes: Tensor | None, coefficients: int) -> None:
        super().__init__()
        if rig.neutral.landmarks is None:
            raise ShapeError("rig: found no landmarks, expected the 68 of iBUG's order; see torchface annotate")
        points = FacePoints.of(rig.linear("WebcamSolver"), rig.neutral.landmarks)
        basis, remainder = likeliest_differences(identity_modes, coefficients)
        closing_basis, closing_shapes = torch.zeros(2, *basis.shape).double(), torch.zeros(2, len(rig.names)).double()
        for upper, lower, closing in lid_pairs(rig.names):  # what the lids' offsets take of their way as an eye shuts
            eye, apart = int(upper >= _LEFT_EYE), 0.5 * (basis[upper] - basis[lower])
            closing_basis[eye, upper], closing_basis[eye, lower], closing_shapes[eye] = apart, -apart, closing.double()
        # All points of a contour landmark's curve take its displacement.
        owner = torch.arange(len(points.rest))
        for landmark, (row, valid) in enumerate(zip(points.rows, points.valid, strict=True)):  # curves have own lengths
            owner[row[valid]] = landmark
        for name, value in {
            "rest": points.rest,
            "basis": points.basis,
            "rows": points.rows,
            "valid": points.valid,
            "side": points.side,
            "owner": owner,
            "person_basis": basis,
            "person_remainder": remainder,
            "closing_basis": closing_basis,
            "closing_shapes": closing_shapes,
        }.items():
            self.register_buffer(name, value)

    def points(self, person: Tensor) -> FacePoints:
        """The rig's points where this person's landmarks lie, of coefficients (D,); all lids shut alike."""
        moved = self.person_basis @ person
        closing = self.closing_basis @ person
        basis = torch.cat(
            [
                self.basis[:LANDMARKS] - (closing[..., None] * self.closing_shapes[:, None, None]).sum(0),
                self.basis[LANDMARKS:],
            ]
        )
        return FacePoints(self.rest + moved[self.owner], basis, self.rows, self.valid, self.side)

    def information(
        self, at: Linearised, head: HeadState, person: Tensor, penalty: float, resting: Tensor, read: Quadratic
    ) -> tuple[Tensor, Tensor]:
        r"""What a frame's residuals say of the person, expression and pose marginalised out.

        .. math:: A = J_z^\top J_z - J_z^\top J_x (J_x^\top J_x + \Lambda)^{-1} J_x^\top J_z, \quad
            g = J_z^\top r - J_z^\top J_x (J_x^\top J_x + \Lambda)^{-1} (J_x^\top r + \Lambda x)

        with :math:`\Lambda` what readings of the weights say, and x beside what was read; of shapes that nothing reads,
        the quadratic that an L1 penalty on the weights touches: shapes at rest are likely to be, what is active is
        left open.

        Args:
            at: the frame's residuals, linearised at the state.
            head: the state of one face.
            person: the coefficients there, (D,).
            penalty: for a weight of 1.
            resting: whether the person has been asked to rest, () bool.
            read: energy of the weights (1,N) by what was read of them.

        Returns:
            A (D,D), and :math:`A z - g` (D,): the information vector of the coefficients.

        Source: Candès, Wakin and Boyd 2008 for the penalty.
        """
        weights, by_place = head.weights[0], at.jacobian[0, ..., -3:]
        closed = self.closing_shapes @ weights
        basis = self.person_basis - (closed[:, None, None, None] * self.closing_basis).sum(0)
        by_person = (by_place @ head.rotation[0] @ basis).flatten(0, 1)
        by_head, residual = at.jacobian[0].flatten(0, 1), at.residual[0].flatten()
        unread = read.H[0].diagonal() <= 0
        rest = torch.where(resting, _RESTING * penalty / _SOFTENING, unread * penalty / (weights + _SOFTENING))
        known = rest.diag() + _READINGS * read.H[0]
        pull = rest * weights + _READINGS * (read.H[0] @ weights + read.f[0])
        known = pad(known, (0, 6, 0, 6)) + pad(0 * weights, (0, 6), value=_POSE_INFORMATION).diag()
        coupling = by_head.T @ by_person
        explained = symmetric_inverse(by_head.T @ by_head + known) @ torch.cat(
            [coupling, (residual @ by_head + pad(pull, (0, 6)))[:, None]], dim=1
        )
        through, count = coupling.T @ explained, by_person.shape[1]
        information = by_person.T @ by_person - through[:, :count]
        information = 0.5 * (information + information.T)
        return information, information @ person - (residual @ by_person - through[:, count])

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *rest: Any) -> None:
        """As modules do; but another rig's contour may have more or fewer points than this one's."""
        make_room_for_points(self, state_dict, prefix, ("owner",))
        super()._load_from_state_dict(state_dict, prefix, *rest)  # type: ignore[arg-type]


def likeliest_differences(identity_modes: Tensor | None, count: int) -> tuple[Tensor, Tensor]:
    """The D likeliest ways in which people's landmarks differ, float64; see :class:`PersonLandmarks`.

    Returns:
        What a standard deviation of each adds to each landmark, (68,3,D), millimetres, and the variance of a coordinate
        that they leave out, (68,), mm².
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
    visible = torch.tensor(VISIBLE, dtype=torch.float64).repeat(LANDMARKS)
    values, vectors = torch.linalg.eigh(visible[:, None] * covariance * visible)
    values, vectors = values.flip(0)[:count], vectors.flip(1)[:, :count]
    # LAPACK's builds differ in a vector's sign and in vectors of one eigenvalue; a kept state means the same person
    # everywhere.
    vectors = vectors * vectors.gather(0, vectors.abs().argmax(0, keepdim=True)).sign()
    basis = vectors * values.sqrt() / visible[:, None]
    left = (covariance.diagonal() - basis.square().sum(1)).clamp(min=0)
    return basis.unflatten(0, (LANDMARKS, 3)), left.unflatten(0, (LANDMARKS, 3))[:, :2].mean(1)
