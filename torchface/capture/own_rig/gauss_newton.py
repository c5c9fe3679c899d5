"""Gauss-Newton on the reprojection of landmarks: linearised energies of a step, and the step to their least in a box.

An energy of a step is a ``Quadratic`` (B,N+6): of what N weights change by, and of the head's motion in the camera's
frame. Energies add up, and :func:`box_step` or :func:`split_step` goes to the least of their sum in the box.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate
from operator import mul

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

from torchface.capture.energy import Quadratic
from torchface.capture.own_rig.face_points import JAW, FacePoints
from torchface.geometry.cameras.pnp import pixel_jacobian
from torchface.geometry.rotations import rotation_matrix
from torchface.optim.exported_operators import split_box_program, split_box_program_quickly
from torchface.optim.prepared_program import PreparedProgram

SLIDING_STEPS = 3
"""Steps of a frame in which landmarks of the contour may slide: later they could go back and forth."""

_RHO = 0.05  # of the splitting's metric, a share of H's diagonal
_FREE = 1e9  # a bound that no motion reaches
_HALVINGS = 3
# θ/sin θ in powers of sin²(θ/2): 1, 2/3, 8/15, ...; after halving, exact to 1e-12 up to half a turn.
_SERIES = tuple(accumulate((2 * k / (2 * k + 1) for k in range(1, 8)), mul, initial=1.0))


@dataclass(frozen=True, eq=False)
class HeadState:
    """Weights and poses of B faces."""

    weights: Tensor  # (B,N)
    rotation: Tensor  # rig to camera, (B,3,3)
    translation: Tensor  # rig to camera, (B,3), millimetres

    def stepped(self, step: Tensor) -> "HeadState":
        """After a step (B,N+6): of weights, a rotation vector in the camera's frame (radians), and millimetres."""
        return self.moved(self.weights + step[:, :-6], step[:, -6:])

    def moved(self, weights: Tensor, motion: Tensor) -> "HeadState":
        """With other weights (B,N), after a motion (B,6)."""
        rotation = rotation_matrix(motion[:, :3]) @ self.rotation
        return HeadState(weights, rotation, self.translation + motion[:, 3:])

    def step_from(self, start: "HeadState") -> Tensor:
        """The step (B,N+6) that leads here from another state; turns are below half a turn."""
        turn = rotation_between(start.rotation, self.rotation)
        return torch.cat([self.weights - start.weights, turn, self.translation - start.translation], dim=1)

    def mapped(self, function: Callable[[Tensor], Tensor]) -> "HeadState":
        """With a function of each of its tensors."""
        return HeadState(function(self.weights), function(self.rotation), function(self.translation))


def rotation_between(start: Tensor, end: Tensor) -> Tensor:
    """The rotation vectors (B,3) from rotations (B,3,3) to others (B,3,3), by sums, products and roots alone.

    ONNX Runtime has no arc functions of float64; see ``torchface.geometry.rotations.rotation_vector``.
    """
    turned = end @ start.transpose(-1, -2)
    skew = 0.5 * (turned - turned.transpose(-1, -2))
    axis = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], dim=1)
    cosine = 0.5 * (turned.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1)
    scale = torch.ones_like(cosine)
    for _ in range(_HALVINGS):  # θ/sin θ is that of half the angle, over the cosine of half the angle
        cosine = (0.5 * cosine + 0.5).clamp(min=1e-12).sqrt()
        scale = scale * cosine
    x, series = 0.5 - 0.5 * cosine, torch.full_like(cosine, _SERIES[-1])
    for coefficient in reversed(_SERIES[:-1]):
        series = series * x + coefficient
    return series / scale * axis


@dataclass(frozen=True, eq=False)
class Linearised:
    """Whitened residuals of landmarks and their derivatives."""

    residual: Tensor  # modelled minus found, in standard deviations, (B,L,2); zero for what is not seen
    jacobian: Tensor  # by the weights and the head's motion, (B,L,2,N+6)

    def energy(self) -> Quadratic:
        r"""The landmarks' energy of a step d, :math:`\tfrac12 \lVert r + J d \rVert^2`."""
        J, r = self.jacobian.flatten(1, 2), self.residual.flatten(1)
        return Quadratic(J.transpose(1, 2) @ J, (r[:, None] @ J)[:, 0])


def linearise(
    points: FacePoints,
    head: HeadState,
    rows: Tensor,
    intrinsics: Tensor,
    landmarks: Tensor,
    precision: Tensor,
    along: float,
) -> Linearised:
    r"""The landmarks' errors in standard deviations, and what moves them.

    .. math:: r_l = W_l \big( \pi(K (R (b_l + B_l w) + t)) - q_l \big)

    Args:
        rows: which point each landmark is, (B,68); see ``FacePoints.chosen``.
        landmarks: q, (B,68,2), pixels, finite.
        precision: one over the standard deviation of each landmark, (B,68), 0 for those not seen.
        along: how much an error along the contour counts beside one across it, 0 to 1.

    Source: thesis 4.2.6, equation 40.
    """
    count, shapes = len(head.weights), points.basis.shape[-1]
    at, basis = points.linearised(head.weights, rows)
    turned = at @ head.rotation.transpose(-1, -2)
    pixels, by_place = pixel_jacobian(turned + head.translation[:, None], intrinsics)
    # Residuals and their derivatives by the points' places go through the same products.
    lines = torch.cat([(pixels - landmarks)[..., None], by_place], dim=-1) * precision[..., None, None]
    lines = sliding(lines, pixels, along)
    residual, by_place = lines[..., 0], lines[..., 1:]
    by_world = (by_place.reshape(count, -1, 3) @ head.rotation).view(by_place.shape)
    by_weights = (by_world @ basis).view(count, -1, 2, shapes)
    by_turn = torch.linalg.cross(turned[:, :, None].expand_as(by_place), by_place)
    return Linearised(residual, torch.cat([by_weights, by_turn, by_place], dim=-1))


def sliding(lines: Tensor, pixels: Tensor, along: float) -> Tensor:
    """Offsets of landmarks (B,68,2,K), or their derivatives, in which those of the contour count less along it than
    across it: ``along``, 0 to 1, times as much."""
    if along >= 1:
        return lines
    contour, jaw = lines[:, :JAW], pixels[:, :JAW]
    beyond = torch.cat([jaw[:, :1], jaw, jaw[:, -1:]], dim=1)
    tangent = normalize(beyond[:, 2:] - beyond[:, :-2], dim=-1)
    squeeze = (1 - along) * tangent[..., :, None] * tangent[..., None, :]
    return torch.cat([contour - squeeze @ contour, lines[:, JAW:]], dim=1)


def energy_of_step(energy: Quadratic, weights: Tensor) -> Quadratic:
    """An energy of N weights as one of a step (B,N+6) from weights (B,N), without its constant."""
    gradient = energy.f + (energy.H @ weights[..., None])[..., 0]
    return Quadratic(pad(energy.H, (0, 6, 0, 6)), pad(gradient, (0, 6)))


def box_step(
    energy: Quadratic, head: HeadState, lower: Tensor, upper: Tensor, exactness: float, rest: Tensor
) -> HeadState:
    """The least of an energy (B,N+6) of a step in a box of weights and motion, exactly: B programs, warm-started.

    ``exactness`` is the residual at which a program counts as solved; shapes that ``rest``, (B,N), are held at 0.
    """
    begin = pad(head.weights, (0, 6))
    H, f = energy.H, energy.f - (energy.H @ begin[..., None])[..., 0]
    free = pad(~rest, (0, 6), value=True).to(H)
    held = torch.diag_embed((1 - free) * H.diagonal(dim1=-2, dim2=-1))
    H, f, begin = H * free[:, :, None] * free[:, None] + held, f * free, begin * free
    least = PreparedProgram(0.5 * (H + H.transpose(1, 2)), lower, upper).solve(f, begin, exactness)
    return head.moved(least[:, :-6], least[:, -6:])


def split_step(
    energy: Quadratic, head: HeadState, upper: Tensor, dual: Tensor, steps: int, quick: bool = False
) -> tuple[HeadState, Tensor]:
    """The step of a frame toward the least of an energy, by a fixed number of splitting's steps, for exported graphs.

    Args:
        energy: of a step from the state, (1,N+6,N+6) and (1,N+6), float64.
        upper: bounds of the weights, (N,); the lower ones are 0.
        dual: the splitting's scaled dual to start from, (N+6,); zeros at a frame's first step.
        quick: in single precision, with an inverse of as many digits.

    Returns:
        The next state, whose weights may leave the box by what the splitting is off, and the dual to go on with.

    Source: Boyd et al. 2011, 3.4.3 and 5.2.
    """
    H, gradient, weights = energy.H[0], energy.f[0], head.weights[0]
    lowest = pad(-weights, (0, 6), value=-_FREE)
    highest = pad(upper - weights, (0, 6), value=_FREE)
    identity = torch.eye(len(gradient), dtype=H.dtype, device=H.device)
    solve = split_box_program_quickly if quick else split_box_program
    step, dual = solve(H, gradient, lowest, highest, dual, identity, _RHO, steps)
    return head.stepped(step), pad(dual[:-6], (0, 6))
