"""Box-constrained quadratic programs in batches: the solver behind every blendshape solve."""

import torch
from torch import Tensor, nn

from torchface.number_checks import as_tensor
from torchface.optim.box_checks import as_vectors, check_vectors, checked_tolerance, default_tolerance
from torchface.optim.data_dependent import data_dependent, is_transformed
from torchface.optim.full_precision import full_precision
from torchface.optim.implicit import BoxSolution
from torchface.optim.prepared_program import PreparedProgram
from torchface.optim.prepared_tensors import Prepared

_EXPORTED = "torchface.optim.ProjectedGradient, whose steps a graph can hold"


@full_precision
def box_qp(
    H: Tensor,
    f: Tensor,
    lower: float | Tensor = 0.0,
    upper: float | Tensor = 1.0,
    start: Tensor | None = None,
    tolerance: float | None = None,
) -> Tensor:
    r"""The minimisers of quadratic functions over a box.

    .. math:: x = \arg\min_{l \le x \le u} \tfrac12 x^\top H x + f^\top x

    Few problems at once are solved one by one by DAQP, a compiled dual active set; many by splitting (products and
    clamps), and then by active sets, which end it exactly. Differentiable in H and f as often as one likes, by implicit
    differentiation at the solution, and under the transforms of ``torch.func``.

    Args:
        H: symmetric up to rounding, which is taken off, and positive semidefinite, (N,N) or (B,N,N), float32 or
            float64. A variable whose row is zero, as of a shape that nothing sees, goes to the bound where f sends it;
            ``ProjectedGradient``, whose metric is the diagonal, refuses it.
        f: (B,N), of the same dtype and device.
        lower: a number or (N,); ``-inf`` for none. Bounds are constants: no gradient flows to them.
        upper: a number or (N,); ``inf`` for none.
        start: a guess, (B,N), such as the frame before; the answer does not depend on it where it is unique.
        tolerance: on the residual :math:`\max |x - clip(x - (Hx+f)/\mathrm{diag} H)|`, relative to :math:`1 + |x|`;
            3e-6 for float32 and 1e-11 for float64 if absent; at most 0.5, and 0 for as near as rounding lets it.

    Returns:
        x, (B,N), within the bounds exactly. Where H is singular and the minimiser not unique, one of them.

    Raises:
        ShapeError: the shapes do not fit each other.
        ValueRangeError: H or f is not finite, H is not symmetric or has a negative eigenvalue, ``lower`` exceeds
            ``upper``, f is more than 1e30 times H's diagonal, ``tolerance`` is not in [0,0.5], or the objective falls
            without end because bounds are infinite or, where H is singular, so wide that no solution comes near them.

    Source: thesis 4.1.4 and appendix, equations 67 and 68.

    Example:
        >>> H = torch.tensor([[2.0, 0.0], [0.0, 4.0]])
        >>> box_qp(H, torch.tensor([[-1.0, -8.0], [2.0, -2.0]])).round(decimals=4).tolist()
        [[0.5, 1.0], [0.0, 0.5]]
    """
    H = as_tensor("H", H, "(N,N) or (B,N,N)")
    f = as_vectors("f", f, H)
    start = None if start is None else as_vectors("start", start, H)
    if is_transformed():
        return _transformed_minimiser(H, f, lower, upper, tolerance)
    return _box_qp(H, f, lower, upper, start, tolerance)


@data_dependent(_EXPORTED)
def _box_qp(
    H: Tensor, f: Tensor, lower: float | Tensor, upper: float | Tensor, start: Tensor | None, tolerance: float | None
) -> Tensor:
    prepared = PreparedProgram.of(H, lower, upper)
    return _minimiser(H, prepared, f, start, checked_tolerance(tolerance, H.dtype))


class BoxQP(nn.Module):
    """``box_qp`` as a module that checks and factors H once for many calls.

    Few problems a call, such as a live frame, start from the active set of the call before.

    H is a buffer, or a parameter where an ``nn.Parameter`` is given. What is prepared from it follows it: an
    optimiser's step, ``load_state_dict``, ``.to()`` and ``.double()`` take effect at the next call.

    Args:
        H: (N,N), or (B,N,N) for exactly B problems a call.
        lower, upper, tolerance: as in ``box_qp``.

    Raises:
        ShapeError, ValueRangeError: as in ``box_qp``; also at a call, where H has become unfit since.

    Example:
        >>> qp = BoxQP(torch.eye(2), lower=0.0, upper=float("inf"))
        >>> qp(torch.tensor([[-3.0, 1.0]])).round(decimals=4).tolist()
        [[3.0, 0.0]]
    """

    H: Tensor
    lower: Tensor
    upper: Tensor

    def __init__(
        self, H: Tensor, lower: float | Tensor = 0.0, upper: float | Tensor = 1.0, tolerance: float | None = None
    ) -> None:
        super().__init__()
        H = as_tensor("H", H, "(N,N) or (B,N,N)")
        self.tolerance = tolerance if tolerance is None else checked_tolerance(tolerance, H.dtype)
        if isinstance(H, nn.Parameter):
            self.H = H
        else:
            self.register_buffer("H", H)
        prepared = PreparedProgram.of(H, lower, upper)
        self.register_buffer("lower", prepared.lower)
        self.register_buffer("upper", prepared.upper)
        self._prepared: Prepared[PreparedProgram] = Prepared()
        self._prepared.get((self.H, self.lower, self.upper), lambda: prepared)

    @full_precision
    def forward(self, f: Tensor, start: Tensor | None = None) -> Tensor:
        """The minimisers (B,N) for f (B,N), of H's dtype; ``start`` is an initial guess (B,N)."""
        f = as_vectors("f", f, self.H)
        start = None if start is None else as_vectors("start", start, self.H)
        if is_transformed():
            return _transformed_minimiser(self.H, f, self.lower, self.upper, self.tolerance)
        return self._solved(f, start)

    @data_dependent(_EXPORTED)
    def _solved(self, f: Tensor, start: Tensor | None) -> Tensor:
        H, lower, upper = self.H, self.lower, self.upper
        prepared = self._prepared.get((H, lower, upper), lambda: PreparedProgram.of(H, lower, upper))
        tolerance = default_tolerance(H.dtype) if self.tolerance is None else self.tolerance
        return _minimiser(H, prepared, f, start, tolerance)

    def extra_repr(self) -> str:
        return f"{self.H.shape[-1]} variables"


def _minimiser(H: Tensor, prepared: PreparedProgram, f: Tensor, start: Tensor | None, tolerance: float) -> Tensor:
    """The minimisers (B,N), differentiable in H and f where these ask for it."""
    check_vectors(H, f, start)
    if not (torch.is_grad_enabled() and (H.requires_grad or f.requires_grad)):
        return prepared.solve(f, start, tolerance)
    solution: Tensor = BoxSolution.apply(
        H, f, prepared.lower, prepared.upper, lambda _, f, *bounds: prepared.solve(f, start, tolerance)
    )
    return solution


def _transformed_minimiser(
    H: Tensor, f: Tensor, lower: float | Tensor, upper: float | Tensor, tolerance: float | None
) -> Tensor:
    """The minimisers under ``torch.func``'s transforms; what is prepared of tensors that they wrap is not kept."""

    def solve(H: Tensor, f: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
        prepared = PreparedProgram.of(H, lower, upper)
        check_vectors(H, f, None)
        return prepared.solve(f, None, checked_tolerance(tolerance, H.dtype))

    bounds = (torch.as_tensor(bound, dtype=torch.float64, device=H.device).detach() for bound in (lower, upper))
    solution: Tensor = BoxSolution.apply(H, f, *bounds, solve)
    return solution
