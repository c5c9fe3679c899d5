"""The energy of weights whose rig has correctives, and its least in a box by Gauss-Newton."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchface.capture.energy import Quadratic, chunks_of_frames
from torchface.correctives.activation import CorrectiveActivation, RoundedActivation
from torchface.optim import box_qp
from torchface.optim.box_problem import BoxProblem
from torchface.optim.implicit import attach_gradients
from torchface.optim.prepared_program import PreparedProgram

_MAX_STEPS = 30
# A step's quadratic program is solved to this share of what is left: more digits are of a model that moves on.
_INEXACT = 0.03
_ROUNDED_TOLERANCE = 1e-2
_HALVINGS, _DECREASE = 20, 1e-4
# What rounding may add to an energy, times its terms.
_ROUNDING = 1e-14


@dataclass(frozen=True, eq=False)
class CorrectiveEnergy:
    r"""An energy that is quadratic in the weights and the activations of correctives,

    .. math:: E(y) = \tfrac12 x^\top H x + f^\top x + c, \qquad x = (y, a(w)),

    where y are L variables: the N weights w, and what else a solve finds, such as a helmet's motion.
    """

    extended: Quadratic  # the quadratic of x, of L + C variables
    activation: CorrectiveActivation  # a, of N shapes and C correctives

    def __add__(self, other: Quadratic) -> "CorrectiveEnergy":
        """With an energy of the L variables added."""
        count = len(self.activation.definitions)
        H = pad(other.H, (0, count, 0, count))
        f = pad(other.f, (0, count))
        return replace(self, extended=self.extended + Quadratic(H, f, other.constant))

    @property
    def variables(self) -> int:
        """L."""
        return self.extended.f.shape[1] - len(self.activation.definitions)

    def rows(self, keep: Tensor) -> "CorrectiveEnergy":
        """Of some frames."""
        H, f, constant = self.extended.H, self.extended.f, self.extended.constant
        H = H if H.ndim == 2 else H[keep]
        constant = constant if constant is None or len(constant) == 1 else constant[keep]
        return replace(self, extended=Quadratic(H, f[keep], constant))

    def value(self, variables: Tensor) -> Tensor:
        """:math:`E` (B,) at (B,L)."""
        return self.extended.value(self._extended(variables))

    def gradient(self, variables: Tensor) -> Tensor:
        """Of E, (B,L) at (B,L); differentiable."""
        slope = self._extended_slope(self._extended(variables))
        return self._by_variables(slope, self.activation.derivative(self._weights(variables)))

    def linearised(self, variables: Tensor) -> BoxProblem:
        r"""E with the activations linear about (B,L), as an unbounded problem without its constant.

        With the derivative A of the activations, :math:`H = (I, A^\top) H_x (I, A^\top)^\top`.
        """
        size, shapes = self.variables, self.activation.shapes
        A = self.activation.derivative(self._weights(variables))
        Hx = self.extended.H
        crossed = self.activation.pulled_back(A, Hx[..., size:, :].contiguous())  # Aᵀ H of the correctives' rows
        by_weights = pad(crossed[..., :size], (0, 0, 0, size - shapes))
        bent = self.activation.pulled_back(A, crossed[..., size:].transpose(1, 2).contiguous())
        H = Hx[..., :size, :size] + by_weights + by_weights.mT + pad(bent, (0, size - shapes, 0, size - shapes))
        H = 0.5 * (H + H.transpose(1, 2))
        slope = self._by_variables(self._extended_slope(self._extended(variables)), A)
        unbounded = slope.new_full((size,), torch.inf)
        return BoxProblem.of(H, slope - (H @ variables[..., None])[..., 0], -unbounded, unbounded)

    def magnitude(self, variables: Tensor) -> Tensor:
        """The size of the terms that E is the sum of, (B,)."""
        x, f = self._extended(variables), self.extended.f
        return (0.5 * x * (self._extended_slope(x) - f)).sum(-1).abs() + (f * x).abs().sum(-1)

    def _weights(self, variables: Tensor) -> Tensor:
        return variables[:, : self.activation.shapes]

    def _extended(self, variables: Tensor) -> Tensor:
        return torch.cat([variables, self.activation(self._weights(variables))], 1)

    def _extended_slope(self, x: Tensor) -> Tensor:
        H = self.extended.H
        return (x @ H if H.ndim == 2 else torch.bmm(H, x[..., None])[..., 0]) + self.extended.f

    def _by_variables(self, slope: Tensor, derivative: Tensor) -> Tensor:
        by_weights = self.activation.slope(derivative, slope[:, self.variables :])
        rest = self.variables - self.activation.shapes
        return slope[:, : self.variables] + pad(by_weights, (0, rest))


def least_in_box(
    energy: CorrectiveEnergy | Quadratic,
    start: Tensor,
    lower: Tensor,
    upper: Tensor,
    tolerance: float,
    far: bool = True,
) -> Tensor:
    r"""The least of an energy in a box near a start, by Gauss-Newton, each frame on its own; of a quadratic its own.

    A step goes to the least of the linearised energy in the box, half as far where E would not fall, and so on.
    Products of weights make E no longer convex: the least is the one downhill of the start. In-betweens bend it at
    their peaks, where a descent may end on the wrong side; so from a start that is far they are parabolas at first.

    Args:
        energy: of B frames.
        start: in the box, (B,L), such as the answer without correctives.
        lower, upper: the box, (L,), infinite where there is no bound.
        tolerance: on the residual :math:`\max |y - clip(y - \nabla E / \mathrm{diag} H)|`, relative to 1 + \|y\|.
        far: the start is no guess of the weights, such as those of the frame before.

    Returns:
        (B,L), float64; differentiable in what the energy is made of, by implicit differentiation at the solution.

    Source: Bertsekas 1982 for steps in a box; Nocedal and Wright 2006, 10.3, for Gauss-Newton.
    """
    if isinstance(energy, Quadratic):
        return box_qp(energy.H, energy.f, lower, upper, start.detach(), tolerance)
    parts = []
    for rows in chunks_of_frames(torch.arange(len(start), device=start.device), energy.extended.f.shape[1]):
        part = energy.rows(rows)
        with torch.no_grad():
            begin = start[rows].detach().clamp(lower, upper)
            if far and len(energy.activation.in_betweens):
                rounded = replace(part, activation=RoundedActivation(energy.activation))
                begin = _descended(rounded, begin, lower, upper, max(tolerance, _ROUNDED_TOLERANCE))
            weights = _descended(part, begin, lower, upper, tolerance)
        if torch.is_grad_enabled() and (part.extended.H.requires_grad or part.extended.f.requires_grad):
            free = (weights > lower) & (weights < upper)
            weights = attach_gradients(part.gradient, weights, free)
        parts.append(weights)
    return torch.cat(parts)


def _descended(energy: CorrectiveEnergy, start: Tensor, lower: Tensor, upper: Tensor, tolerance: float) -> Tensor:
    y = start.clone()
    rows = torch.arange(len(y), device=y.device)
    for _ in range(_MAX_STEPS):
        part, here = energy.rows(rows), y[rows]
        problem = replace(part.linearised(here), lower=lower, upper=upper)
        slope = problem.gradient(here)
        left = problem.residual(here, slope)
        open_ = left > tolerance
        if not bool(open_.all()):
            rows, here, slope, left = rows[open_], here[open_], slope[open_], left[open_]
            part, problem = energy.rows(rows), problem.rows(open_)
        if not len(rows):
            break
        exact = max(tolerance, _INEXACT * float(left.min()))
        step = PreparedProgram(problem.H, lower, upper).solve(problem.f, here, exact) - here
        y[rows], moved = _searched(part, here, step, (slope * step).sum(-1))
        rows = rows[moved]
        if not len(rows):
            break
    return y


def _searched(energy: CorrectiveEnergy, here: Tensor, step: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
    """How far along a step E falls, (B,L), and which frames moved, (B,) bool."""
    value = energy.value(here)
    slack = _ROUNDING * energy.magnitude(here)
    reached, length = here + step, torch.ones_like(value)
    waiting = torch.arange(len(here), device=here.device)
    for _ in range(_HALVINGS):  # few frames need a second try
        part = energy.rows(waiting)
        fallen = part.value(reached[waiting]) <= (value + _DECREASE * length * slope + slack)[waiting]
        waiting = waiting[~fallen]
        if not len(waiting):
            break
        length[waiting] *= 0.5
        reached[waiting] = here[waiting] + length[waiting, None] * step[waiting]
    moved = torch.ones_like(value, dtype=torch.bool)
    moved[waiting] = False
    return torch.where(moved[:, None], reached, here), moved & (step.abs().amax(-1) > 0)
