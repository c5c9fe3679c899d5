"""Objectives of a solve from landmarks: squared distances, or distances as they are, each with its penalties."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchface.capture.anybody.examples.landmark_equations import LandmarkEquations, Unknowns
from torchface.capture.energy import Quadratic, ridge_term, sparsity_term
from torchface.number_checks import LARGEST_WEIGHT, checked_count, checked_number
from torchface.optim import box_qp

# Of the way from the bound's matrix to the second derivative, which may be singular; and the lengths of a step tried.
_NEWTON = 0.95
_LENGTHS = (1.0, 0.6, 0.3, 0.1, 0.03)


class LandmarkObjective(Protocol):
    """Finds the weights in [0,1], and the placement, with the least of what it counts."""

    def minimise(self, equations: LandmarkEquations, initial: Tensor | None = None) -> Unknowns: ...


@dataclass(frozen=True)
class SquaredDistances:
    r"""The mean squared distance over that of the eyes, squared, with penalties: a box-constrained quadratic program.

    .. math:: \frac{1}{|S|} \sum_{i \in S} \lVert r_i(w) \rVert^2 + \beta \sum_k w_k + \varepsilon \lVert w \rVert^2

    Args:
        sparsity: :math:`\beta`, of the L1 penalty.
        ridge: :math:`\varepsilon`, which makes the solution unique where shapes look alike.

    Raises:
        ValueRangeError: a penalty is negative or not finite.

    Source: realtime_facial_animation, equation 2.

    Example:
        >>> from torchface.capture.anybody import AllAtOnce, ExampleSolver, paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> solver = ExampleSolver(examples, AllAtOnce(SquaredDistances(sparsity=0.0)))
        >>> round(solver(examples.landmarks[:1].double())[0, 0].item(), 2)
        1.0
    """

    sparsity: float = 2e-5
    ridge: float = 1e-7

    def __post_init__(self) -> None:
        _check(self)

    def minimise(self, equations: LandmarkEquations, initial: Tensor | None = None) -> Unknowns:
        """The minimum, differentiable in the equations.

        Args:
            equations: of B frames and N shapes, float64.
            initial: guess of the weights, (B,N); the result does not depend on it.
        """
        squares = equations.least_squares(equations.share)
        energy = squares.energy + _penalties(self, equations)
        return squares.unknowns(box_qp(energy.H, energy.f, start=initial))

    def value(self, equations: LandmarkEquations, unknowns: Unknowns) -> Tensor:
        """What is minimised, (B,)."""
        squared = equations.residual(unknowns).square().sum(-1)
        return (equations.share * squared).sum(1) + _penalty(self, unknowns.weights)


@dataclass(frozen=True)
class Distances:
    r"""The mean distance over that of the eyes, as the paper's code sums it: what lies far off pulls no harder.

    .. math::
        \frac{1}{|S|} \sum_{i \in S} \sqrt{\lVert r_i(w) \rVert^2 + \epsilon^2}
        + \beta \sum_k w_k + \varepsilon \lVert w \rVert^2

    Minimised by iteratively reweighted least squares: with distances d of the iterate before each term is at most
    :math:`\lVert r_i \rVert^2 / 2 d_i + d_i / 2`, a quadratic program whose solution has a smaller sum. As that
    converges slowly where shapes look alike, its matrix is made nearly the second derivative, and the length of the
    step the best of a few.

    Args:
        sparsity: :math:`\beta`; the paper's 1 over a sum of pixels is 1 / (68 x the eyes' distance in pixels).
        ridge: :math:`\varepsilon`.
        smoothing: :math:`\epsilon`, over the eyes' distance.
        iterations: at most.
        tolerance: of weights between two iterations, after which it ends.

    Raises:
        ValueRangeError: a number is negative or not finite, ``smoothing`` or ``iterations`` is zero.

    Source: realtime_facial_animation, appendix, ``minFunction``; Weiszfeld 1937.

    Example:
        >>> from torchface.capture.anybody import AllAtOnce, ExampleSolver, paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> solver = ExampleSolver(examples, AllAtOnce(Distances(sparsity=0.0)))
        >>> round(solver(examples.landmarks[:1].double())[0, 0].item(), 2)
        1.0
    """

    sparsity: float = 1e-4
    ridge: float = 1e-6
    smoothing: float = 5e-4
    iterations: int = 60
    tolerance: float = 1e-4

    def __post_init__(self) -> None:
        _check(self)
        checked_number("Distances: smoothing", self.smoothing, 0.0, 1.0, above=True)
        checked_count("Distances: iterations", self.iterations, 1, 10_000)
        checked_number("Distances: tolerance", self.tolerance, 0.0, 1.0)

    def minimise(self, equations: LandmarkEquations, initial: Tensor | None = None) -> Unknowns:
        """The minimum, differentiable in the equations; see :class:`SquaredDistances`."""
        with torch.no_grad():
            unknowns = self._iterate(equations, initial)
        if torch.is_grad_enabled() and any(
            part.requires_grad for part in (equations.basis, equations.offset, equations.scale, equations.free)
        ):
            # With the second derivative at the minimum the program has the same minimum, and its derivative.
            at = torch.cat([unknowns.weights, unknowns.free], dim=1)
            whole = self._step(equations, at, 1.0)
            return Unknowns(*whole.tensor_split([unknowns.weights.shape[1]], dim=1))
        return unknowns

    def value(self, equations: LandmarkEquations, unknowns: Unknowns) -> Tensor:
        """What is minimised, (B,)."""
        return (equations.share * self._distances(equations, unknowns)).sum(1) + _penalty(self, unknowns.weights)

    def _distances(self, equations: LandmarkEquations, unknowns: Unknowns) -> Tensor:
        return (equations.residual(unknowns).square().sum(-1) + self.smoothing**2).sqrt()

    def _iterate(self, equations: LandmarkEquations, initial: Tensor | None) -> Unknowns:
        squares = equations.least_squares(equations.share)
        if initial is None:
            # The penalties are those of distances; of squares a ridge alone is needed, to start from somewhere.
            energy = squares.energy + ridge_term(equations.basis.shape[-1], 1e-6, equations.basis)
            initial = box_qp(energy.H, energy.f)
        initial_unknowns = squares.unknowns(initial.clamp(0, 1))
        shapes = initial_unknowns.weights.shape[1]
        best = torch.cat([initial_unknowns.weights, initial_unknowns.free], dim=1)
        least = self.value(equations, initial_unknowns)
        rows, part = torch.arange(len(best), device=best.device), equations
        for _ in range(self.iterations):
            before = best[rows]
            step = self._step(part, before, _NEWTON) - before
            tried = [before + length * step for length in _LENGTHS]
            values = torch.stack([self.value(part, Unknowns(*one.tensor_split([shapes], dim=1))) for one in tried])
            value, length = values.min(0)
            lower = value < least[rows]
            after = torch.stack(tried)[length, torch.arange(len(rows), device=best.device)]
            best[rows] = torch.where(lower[:, None], after, before)
            least[rows] = torch.where(lower, value, least[rows])
            moving = lower & ((after - before)[:, :shapes].abs().amax(1) > self.tolerance)
            if not bool(moving.any()):
                break
            rows, part = rows[moving], part.rows(moving)
        return Unknowns(best[:, :shapes], best[:, shapes:])

    def _step(self, equations: LandmarkEquations, at: Tensor, newton: float) -> Tensor:
        """The minimum of a quadratic program that touches the objective at weights and placement (B,N+F).

        Args:
            equations: of B frames.
            at: weights and placement.
            newton: the share of what makes its matrix the second derivative rather than that of the bound.
        """
        shapes = equations.basis.shape[-1]
        unknowns = Unknowns(at[:, :shapes], at[:, shapes:])
        residual, columns = equations.residual(unknowns), equations.columns()
        inverse = equations.share / (residual.square().sum(-1) + self.smoothing**2).sqrt()
        first = ((inverse[..., None] * residual)[..., None] * columns).sum((1, 2))
        slope = _penalties(self, equations).f + 2 * self.ridge * unknowns.weights
        first = first + torch.nn.functional.pad(slope, (0, unknowns.free.shape[1]))
        with torch.no_grad():
            flat = columns.flatten(1, 2)
            counted = (inverse[..., None, None] * columns).flatten(1, 2)
            along = (residual[..., None] * columns).sum(2)  # (B,68,N+F)
            steep = newton * inverse**3 / equations.share.clamp(min=1e-30).square()
            H = counted.transpose(1, 2) @ flat - (steep[..., None] * along).transpose(1, 2) @ along
            H = 0.5 * (H + H.transpose(1, 2))
            H.diagonal(dim1=1, dim2=2)[:, :shapes].add_(2 * self.ridge)
            free = unknowns.free.shape[1]
            lower = at.new_tensor([0.0] * shapes + [-torch.inf] * free)
            upper = at.new_tensor([1.0] * shapes + [torch.inf] * free)
        return box_qp(H, first - (H @ at[..., None])[..., 0], lower, upper, at)


def _penalties(objective: SquaredDistances | Distances, equations: LandmarkEquations) -> Quadratic:
    shapes, like = equations.basis.shape[-1], equations.basis.detach()
    return sparsity_term(shapes, objective.sparsity, like) + ridge_term(shapes, objective.ridge, like)


def _penalty(objective: SquaredDistances | Distances, weights: Tensor) -> Tensor:
    return objective.sparsity * weights.sum(1) + objective.ridge * weights.square().sum(1)


def _check(objective: SquaredDistances | Distances) -> None:
    for name in ("sparsity", "ridge"):
        checked_number(f"{type(objective).__name__}: {name}", getattr(objective, name), 0.0, LARGEST_WEIGHT)
