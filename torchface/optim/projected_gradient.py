r"""Accelerated projected gradient for box-constrained quadratic programs: a layer of products and clamps alone.

A step goes down the gradient in the metric :math:`D = \mathrm{diag} H`, with Nesterov's momentum,

.. math::
    x' = \mathrm{clip}(y - \tfrac{\omega}{\lambda} D^{-1} (H y + f)), \qquad y' = x' + \tfrac{k}{k+3} (x' - x),

with :math:`\lambda` the largest eigenvalue of :math:`D^{-1} H`. Where the momentum leads uphill,
:math:`(y - x')^\top D (x' - x) > 0`, k starts again from 0.

Source: Nesterov 2004, 2.2; O'Donoghue and Candès 2015, Adaptive restart for accelerated gradient schemes.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import as_tensor, checked_count, checked_number
from torchface.optim.box_checks import as_vectors, check_call, checked_bounds, checked_hessian
from torchface.optim.box_problem import metric
from torchface.optim.data_dependent import is_recorded, is_transformed
from torchface.optim.full_precision import full_precision
from torchface.optim.implicit import free_step
from torchface.optim.prepared_tensors import Prepared

# Accelerated steps on quadratics are stable below 4/3; power iteration may find a few per cent less than it should.
_OVER_RELAXATION = 1.2
_POWER_STEPS = 40
_NAME = "ProjectedGradient"
_State = tuple[Tensor, ...]


class ProjectedGradient(nn.Module):
    r"""Box-constrained quadratic programs by accelerated projected gradient, the same in PyTorch and in ONNX.

    .. math:: x = \arg\min_{l \le x \le u} \tfrac12 x^\top H x + f^\top x

    All steps are products and clamps, so H is not factored; frames may share H or have one each. ``box_qp`` is exact
    and, for many problems of one H, faster; this layer also compiles and exports: ``torch.compile`` and
    ``torch.export`` keep one loop, ``torch.onnx.export`` writes it as an ONNX ``Loop``, and it works under the
    transforms of ``torch.func``.

    Args:
        H: (N,N) or (B,N,N), symmetric and positive semidefinite without a row of zeros; a buffer, or a parameter where
            an ``nn.Parameter`` is given. May be absent where each call has its own.
        lower: a number or (N,); ``-inf`` for none. Bounds are kept in float64, which ``.float()`` rounds for good, and
            rounded to the dtype of f.
        upper: a number or (N,); ``inf`` for none.
        steps: at most so many. On 53 shapes of a real rig the worst relative gap is 5e-4 after 200 and 2e-8 after 400.
        tolerance: where given, it stops before, when no problem's residual
            :math:`\max |x - clip(x - (Hx+f)/\mathrm{diag} H)|` exceeds it; not under the transforms of ``torch.func``.
        through_steps: gradients go back through every step; otherwise they are implicit ones at the solution, of any
            order, exact where the steps have found which variables are at bounds.

    Raises:
        ShapeError: H is not square, or bounds do not fit it.
        ValueRangeError: H is not finite, symmetric and positive semidefinite, or has a row of zeros; or ``lower``
            exceeds ``upper``, or ``steps`` or ``tolerance`` is out of range.

    Source: thesis 4.1.4 and appendix, equations 67 and 68.

    Example:
        >>> H = torch.tensor([[2.0, 0.0], [0.0, 4.0]])
        >>> layer = ProjectedGradient(H)
        >>> layer(torch.tensor([[-1.0, -8.0], [2.0, -2.0]])).round(decimals=4).tolist()
        [[0.5, 1.0], [0.0, 0.5]]
        >>> ProjectedGradient()(torch.tensor([[-1.0, -8.0]]), 2 * H).round(decimals=4).tolist()
        [[0.25, 1.0]]
    """

    H: Tensor | None
    eigenvalue: Tensor | None
    lower: Tensor
    upper: Tensor

    def __init__(
        self,
        H: Tensor | None = None,
        lower: float | Tensor = 0.0,
        upper: float | Tensor = 1.0,
        steps: int = 400,
        tolerance: float | None = None,
        through_steps: bool = False,
    ) -> None:
        super().__init__()
        self.steps = checked_count("ProjectedGradient: steps", steps)
        self.tolerance = None if tolerance is None else checked_number("ProjectedGradient: tolerance", tolerance)
        self.through_steps = through_steps
        self._followed: Prepared[Tensor] = Prepared()
        H = None if H is None else as_tensor("H", H, "(N,N) or (B,N,N)")
        if isinstance(H, nn.Parameter):
            self.H = H
        else:
            self.register_buffer("H", H)
        if H is not None:
            checked_hessian(H, _NAME)
            _check_diagonal(H)
        # A parameter's changes with it, in a compiled call too.
        kept = None if H is None or isinstance(H, nn.Parameter) else largest_eigenvalue(H.detach())
        self.register_buffer("eigenvalue", kept)
        low, high = checked_bounds(lower, upper, H, _NAME)
        self.register_buffer("lower", low)
        self.register_buffer("upper", high)

    @full_precision
    def forward(self, f: Tensor, H: Tensor | None = None, start: Tensor | None = None) -> Tensor:
        """The minimisers (B,N), within the bounds exactly.

        Args:
            f: (B,N), of H's dtype.
            H: (N,N) or (B,N,N); the module's own if absent. Only its shape, dtype, entries and diagonal are checked.
            start: a guess, (B,N), such as the frame before.

        Raises:
            ShapeError, ValueRangeError: the inputs do not fit each other, are not finite, or H has a row of zeros. A
                compiled or exported call, and one under a transform, checks shapes alone.
        """
        own = H is None
        H = self.H if H is None else H
        if H is None:
            raise ShapeError("ProjectedGradient: found no H, expected one here or where the module is made")
        H = as_tensor("H", H, "(N,N) or (B,N,N)")
        f = as_vectors("f", f, H)
        start = None if start is None else as_vectors("start", start, H)
        check_call(H, f, start, _NAME, self.lower)
        if not (own or is_recorded() or is_transformed()):
            _check_diagonal(H)
        learns = torch.is_grad_enabled() and not torch.onnx.is_in_onnx_export()  # a file has no gradients
        asks = is_transformed() or (learns and (f.requires_grad or H.requires_grad))
        lower, upper = self.lower.to(f), self.upper.to(f)
        if asks and self.through_steps:
            return self._steps(H, f, start, self._eigenvalue(H, own), (lower, upper))
        guess = None if start is None else start.detach()
        with torch.no_grad():
            x = self._steps(H.detach(), f.detach(), guess, self._eigenvalue(H.detach(), own), (lower, upper))
        if not asks:
            return x
        moved = free_step(H, f, x, (x > lower) & (x < upper))
        return x + (moved - moved.detach())

    def _eigenvalue(self, H: Tensor, own: bool) -> Tensor:
        """That of the module's H is a buffer, which follows H where the values can be looked at."""
        kept = self.eigenvalue
        if not own or kept is None:
            return largest_eigenvalue(H)
        if not (is_recorded() or is_transformed()):
            found = self._followed.get((H,), lambda: largest_eigenvalue(H))
            if found.device != kept.device or not torch.equal(found.to(kept), kept):
                self.eigenvalue = kept = found.to(kept)
        return kept

    def _steps(
        self, H: Tensor, f: Tensor, start: Tensor | None, eigenvalue: Tensor, box: tuple[Tensor, Tensor]
    ) -> Tensor:
        lower, upper = box
        spread = metric(H)
        eigenvalue = eigenvalue.to(H) / _OVER_RELAXATION
        rate = 1 / (eigenvalue[..., None] * spread)
        matrix = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device) - H * rate[..., None, :]
        constant = -f * rate
        weighed = spread[..., None]

        def product(x: Tensor, factor: Tensor) -> Tensor:
            return x @ factor if factor.ndim == 2 else (x[:, None] @ factor)[:, 0]

        def step(number: Tensor, x: Tensor, y: Tensor, age: Tensor, *_: Tensor) -> _State:
            found = torch.minimum(torch.maximum(product(y, matrix) + constant, lower), upper)
            back, moved = y - found, found - x
            age = torch.where(product(back * moved, weighed)[:, 0] > 0, 0.0, age)
            after = number + 1, found, found + (age / (age + 3))[:, None] * moved, age + 1
            return after if self.tolerance is None else (*after, (back.abs() * eigenvalue[..., None]).amax(1))

        x = torch.minimum(torch.maximum(torch.zeros_like(f) if start is None else start, lower), upper)
        counted = torch.zeros((), dtype=torch.int64, device=f.device)
        # Of a column (B,1) torch.export may take the 1 for a size that varies, after a loop of other sizes.
        state: _State = (counted, x, x.clone(), torch.zeros_like(f[:, 0]))
        state = state if self.tolerance is None else (*state, torch.full_like(f[:, 0], torch.inf))
        return _looped(step, state, self.steps, self.tolerance)[1]

    @property
    def config(self) -> dict[str, Any]:
        """Arguments of the class beside H and the bounds."""
        return {"steps": self.steps, "tolerance": self.tolerance, "through_steps": self.through_steps}

    def extra_repr(self) -> str:
        size = "an H a call" if self.H is None else f"{self.H.shape[-1]} variables"
        return ", ".join([size, *(f"{name}={value}" for name, value in self.config.items())])


def largest_eigenvalue(H: Tensor) -> Tensor:
    r"""The largest eigenvalue of :math:`(\mathrm{diag} H)^{-1} H`, (N,N) or (B,N,N), by power iteration, from below."""
    spread = metric(H)
    # Without a pattern that the eigenvector could be orthogonal to.
    v = torch.cos(1.0 + torch.arange(H.shape[-1], dtype=H.dtype, device=H.device).square()) * spread.rsqrt()

    def step(number: Tensor, v: Tensor) -> _State:
        v = (H @ v[..., None])[..., 0] / spread
        return number + 1, v / (v.square() * spread).sum(-1, keepdim=True).sqrt()

    _, v = _looped(step, (torch.zeros((), dtype=torch.int64, device=H.device), v), _POWER_STEPS)
    return ((H @ v[..., None])[..., 0] * v).sum(-1)


def _looped(step: Callable[..., _State], state: _State, steps: int, tolerance: float | None = None) -> _State:
    """Steps of a state whose first is their number, until its last, where a tolerance is given, comes down to that.

    Compiled and exported graphs hold them as one loop.
    """
    if is_recorded() and not torch.is_grad_enabled():

        def going(number: Tensor, *rest: Tensor) -> Tensor:
            return number < steps if tolerance is None else (number < steps) & (rest[-1] > tolerance).any()

        found: _State = torch.while_loop(going, step, state)
        return found
    for _ in range(steps):  # each needs the one before
        state = step(*state)
        if tolerance is not None and not is_transformed() and not bool((state[-1] > tolerance).any()):
            break
    return state


def _check_diagonal(H: Tensor) -> None:
    empty = (H.diagonal(dim1=-2, dim2=-1) < metric(H)).nonzero()
    if len(empty):
        rows = sorted({int(row) for row in empty[:, -1]})[:5]
        raise ValueRangeError(
            f"ProjectedGradient: found rows {rows} of H that are zero, or nearly so beside the largest diagonal entry, "
            f"{float(H.diagonal(dim1=-2, dim2=-1).max()):.3g}; expected a positive diagonal: nothing holds these "
            "variables; add a ridge to H, or leave them out"
        )
