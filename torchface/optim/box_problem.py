"""A batch of box-constrained quadratic programs: its gradient, objective and how far a point is from the optimum."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ValueRangeError

# Below this share of the largest, a diagonal entry counts as zero: the variable is as good as linear.
_SMALLEST_DIAGONAL = 1e-12


@dataclass(frozen=True, eq=False)
class BoxProblem:
    r"""B problems :math:`\min \tfrac12 x^\top H x + f^\top x,\ l \le x \le u`, in float64."""

    H: Tensor  # symmetric, positive semidefinite, (N,N) for all problems or (B,N,N)
    f: Tensor  # (B,N)
    # lower, upper: (N,), infinite where there is no bound
    lower: Tensor
    upper: Tensor
    diagonal: Tensor  # the metric, diag H kept from zero, (N,) or (B,N)

    @staticmethod
    def of(H: Tensor, f: Tensor, lower: Tensor, upper: Tensor) -> "BoxProblem":
        return BoxProblem(H, f, lower, upper, metric(H))

    def rows(self, keep: Tensor | slice) -> "BoxProblem":
        """Some of the problems."""
        if isinstance(keep, Tensor) and keep.dtype == torch.bool and bool(keep.all()):
            return self
        if self.H.ndim == 2:
            return BoxProblem(self.H, self.f[keep], self.lower, self.upper, self.diagonal)
        return BoxProblem(self.H[keep], self.f[keep], self.lower, self.upper, self.diagonal[keep])

    def clip(self, x: Tensor) -> Tensor:
        return torch.clamp(x, self.lower, self.upper)

    def curvature(self, x: Tensor) -> Tensor:
        """:math:`Hx` for x (B,N)."""
        # A row by a symmetric H takes a third of the time of H by a column.
        return x @ self.H if self.H.ndim == 2 else torch.bmm(x[:, None], self.H)[:, 0]

    def gradient(self, x: Tensor) -> Tensor:
        return self.curvature(x) + self.f

    def objective(self, x: Tensor) -> Tensor:
        """:math:`\\tfrac12 x^\\top H x + f^\\top x`, (B,)."""
        return (x * (0.5 * self.curvature(x) + self.f)).sum(-1)

    def change(self, moved: Tensor, gradient: Tensor) -> Tensor:
        """What a move m from a point of gradient g adds to the objective, without the cancellation of two of them."""
        return (moved * (gradient + 0.5 * self.curvature(moved))).sum(-1)

    def residuals(self, x: Tensor, gradient: Tensor | None = None) -> Tensor:
        """:math:`|x - clip(x - (Hx+f)/diag H)|_i / (1 + |x_i|)`, (B,N); zero everywhere only at the optimum."""
        gradient = self.gradient(x) if gradient is None else gradient
        step = self.clip(torch.addcdiv(x, gradient, self.diagonal, value=-1)).sub_(x).abs_()
        return step.div_(x.abs().add_(1))

    def residual(self, x: Tensor, gradient: Tensor | None = None) -> Tensor:
        """The largest of a problem's residuals, (B,)."""
        return self.residuals(x, gradient).amax(-1)

    def unsolved(self, x: Tensor, tolerance: float, gradient: Tensor | None = None) -> Tensor:
        """Where a residual exceeds both the tolerance and what rounding alone can leave of it, (B,) bool."""
        gradient = self.gradient(x) if gradient is None else gradient
        residuals = self.residuals(x, gradient)
        open_ = residuals.amax(-1) > tolerance
        rows = open_.nonzero()[:, 0]
        if not len(rows):
            return open_
        part = self
        if len(rows) < len(x):
            part, x, gradient, residuals = self.rows(rows), x[rows], gradient[rows], residuals[rows]
        sums = BoxProblem(part.H.abs(), part.f.abs(), part.lower, part.upper, part.diagonal).gradient(x.abs())
        rounding = 4 * torch.finfo(x.dtype).eps * sums
        above = residuals > (rounding / part.diagonal / (1 + x.abs())).clamp(min=tolerance)
        # What rounding may have added to a steep gradient is longer than a box, and its sign still certain.
        certain = part.residuals(x, gradient.sign() * (gradient.abs() - rounding).clamp(min=0)) > tolerance
        open_[rows] = (above | certain).any(-1)
        return open_


def check_box(name: str, lower: Tensor, upper: Tensor) -> None:
    """Checks bounds, (N,) or (): numbers, or infinite for none, and none above the other."""
    if bool(((lower <= upper) & (lower < torch.inf) & (upper > -torch.inf)).all()):
        return
    lower, upper = lower.reshape(-1), upper.reshape(-1)
    for which, bound in (("lower", lower), ("upper", upper)):
        if torch.isnan(bound).any():
            raise ValueRangeError(f"{name}: {which} holds NaN, expected numbers or infinity")
    crossed = (lower > upper).nonzero()[:, 0]
    if len(crossed):
        where = int(crossed[0])
        raise ValueRangeError(
            f"{name}: found lower {float(lower[where])} above upper {float(upper[where])} at variable {where}"
        )
    raise ValueRangeError(f"{name}: found a lower bound of inf or an upper bound of -inf, which nothing can meet")


def metric(H: Tensor) -> Tensor:
    """diag H with entries that are as good as zero lifted, (N,) or (B,N)."""
    diagonal = H.diagonal(dim1=-2, dim2=-1)
    floor = _SMALLEST_DIAGONAL * diagonal.amax(-1, keepdim=True)
    return torch.where(floor > 0, torch.maximum(diagonal, floor), 1.0)
