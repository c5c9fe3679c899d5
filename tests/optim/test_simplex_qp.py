"""simplex_qp finds the minimum: conditions of optimality, scipy, planted mixtures, derivatives, bad input."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as some
from scipy.optimize import minimize
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.optim import SimplexQP, simplex_qp


def problem(variables: int, features: int, problems: int, noise: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Points near mixtures of some of N points: H (N,N), of rank ``features`` at most, and f (B,N)."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    points = normal(features, variables)
    mixture = torch.rand(problems, variables, generator=generator, dtype=torch.float64) ** 30
    target = (mixture / mixture.sum(1, keepdim=True)) @ points.T + noise * normal(problems, features)
    return points.T @ points, -target @ points


def slack(H: Tensor, f: Tensor, x: Tensor) -> float:
    """By how much a gradient lies below the multiplier of the sum: 0 at the minimum."""
    gradient = (x @ H if H.ndim == 2 else torch.bmm(H, x[..., None])[..., 0]) + f
    return float(((x * gradient).sum(1) - gradient.amin(1)).max())


@pytest.mark.parametrize(
    ("variables", "features", "noise"), [(1, 3, 0.1), (2, 1, 1.0), (20, 30, 0.1), (200, 12, 1.0), (150, 200, 0.5)]
)
def test_no_other_point_of_the_simplex_is_lower(variables: int, features: int, noise: float) -> None:
    H, f = problem(variables, features, 40, noise)
    x = simplex_qp(H, f)
    assert float(x.min()) >= 0
    torch.testing.assert_close(x.sum(1), torch.ones(40, dtype=torch.float64), atol=1e-12, rtol=0)
    assert slack(H, f, x) <= 1e-9 * float(H.diagonal().max())
    single = simplex_qp(H.float(), f.float())
    assert slack(H, f, single.double()) <= 1e-5 * float(H.diagonal().max())


def test_scipy_finds_the_same() -> None:
    H, f = problem(8, 10, 5, 0.5)
    found = simplex_qp(H, f)
    for row, x in zip(f.numpy(), found.numpy(), strict=True):
        peer = minimize(
            lambda y, row=row: 0.5 * y @ H.numpy() @ y + row @ y,
            np.full(8, 1 / 8),
            jac=lambda y, row=row: H.numpy() @ y + row,
            bounds=[(0, None)] * 8,
            constraints={"type": "eq", "fun": lambda y: y.sum() - 1, "jac": lambda y: np.ones(8)},
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 500},
        )
        np.testing.assert_allclose(x, peer.x, atol=1e-5)


def test_mixtures_of_independent_points_come_back() -> None:
    generator = torch.Generator().manual_seed(3)
    points = torch.randn(40, 25, generator=generator, dtype=torch.float64)
    planted = torch.rand(100, 25, generator=generator, dtype=torch.float64) ** 20
    planted = planted / planted.sum(1, keepdim=True)
    found = simplex_qp(points.T @ points, -(planted @ points.T) @ points)
    torch.testing.assert_close(found, planted, atol=1e-7, rtol=0)


def test_a_point_of_many_alike_is_explained_by_them() -> None:
    """Neighbouring frames are nearly one: H is singular, the mixture not unique, what it stands for is."""
    H, f = problem(30, 6, 20, 0.3)
    twice, both = torch.cat([torch.cat([H, H]), torch.cat([H, H])], 1), torch.cat([f, f], 1)
    found = simplex_qp(twice, both)
    alone = simplex_qp(H, f)
    assert slack(twice, both, found) <= 1e-9 * float(H.diagonal().max())
    torch.testing.assert_close((found[:, :30] + found[:, 30:]) @ H, alone @ H, atol=1e-6, rtol=0)


@settings(max_examples=25, deadline=None)
@given(some.integers(1, 30), some.integers(1, 40), some.integers(0, 2**16), some.booleans())
def test_whatever_the_problem_it_is_solved_from_any_start(variables: int, features: int, seed: int, own: bool) -> None:
    H, f = problem(variables, features, 6, 1.0, seed)
    generator = torch.Generator().manual_seed(seed)
    start = torch.rand(6, variables, generator=generator, dtype=torch.float64) + 0.01
    H = H.expand(6, -1, -1) if own else H
    for begin in (None, start):
        x = simplex_qp(H, f, begin)
        assert slack(H, f, x) <= 1e-8 * float(H.abs().max() + f.abs().max())


def test_derivatives_are_those_of_finite_differences() -> None:
    H, f = problem(6, 8, 3, 0.7)
    assert bool(((simplex_qp(H, f) > 0).sum(1) > 1).any())

    def solved(root: Tensor, f: Tensor) -> Tensor:
        return simplex_qp(0.5 * (root + root.T), f)

    arguments = (H.clone().requires_grad_(), f.clone().requires_grad_())
    assert torch.autograd.gradcheck(solved, arguments, eps=1e-6, atol=1e-5)
    own = H.repeat(3, 1, 1).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda H, f: simplex_qp(0.5 * (H + H.transpose(1, 2)), f), (own, arguments[1]), eps=1e-6, atol=1e-5
    )


def test_problems_of_several_matrices_are_solved_as_each_alone() -> None:
    parts = [problem(15, 20, 4, 0.5, seed) for seed in range(3)]
    H, f = torch.stack([H for H, _ in parts]), torch.stack([f for _, f in parts]).requires_grad_()
    found = SimplexQP(H)(f)
    for row, (own, linear) in enumerate(parts):
        torch.testing.assert_close(found[row], simplex_qp(own, linear), atol=1e-9, rtol=0)
    looked_at = torch.randn(found.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (found * looked_at).sum().backward()
    for row, (own, linear) in enumerate(parts):
        alone = linear.clone().requires_grad_()
        (simplex_qp(own, alone) * looked_at[row]).sum().backward()
        torch.testing.assert_close(f.grad[row], alone.grad, atol=1e-8, rtol=0)
    with pytest.raises(ShapeError, match=r"expected \(B,15\) or \(3,B,15\)"):
        SimplexQP(H)(f[:2])


def test_neighbours_that_are_nearly_one_do_not_keep_it_from_the_minimum() -> None:
    """Frames of an animation lie on curves, where many enter together and leave again."""
    curve = problem(200, 12, 1, 0.0, 7)[0][:12].cumsum(1)
    rough = torch.randn(12, 60, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    H, f = curve.T @ curve, -(20 * rough.cumsum(1)).T @ curve
    x = simplex_qp(H, f)
    assert slack(H, f, x) <= 1e-9 * float(H.diagonal().max() + f.amax() - f.amin())


def test_what_is_wrong_is_told() -> None:
    H, f = problem(4, 5, 2, 0.1)
    with pytest.raises(ShapeError, match=r"expected \(B,4\)"):
        simplex_qp(H, f[:, :3])
    with pytest.raises(ShapeError, match=r"found H \(4, 3\)"):
        simplex_qp(H[:, :3], f)
    with pytest.raises(ValueRangeError, match="f holds NaN"):
        simplex_qp(H, f * torch.nan)
    with pytest.raises(ValueRangeError, match="negative start"):
        simplex_qp(H, f, torch.zeros_like(f))
    with pytest.raises(ValueRangeError, match="not symmetric"):
        simplex_qp(H + torch.rand(4, 4, dtype=torch.float64).triu(1), f)
    with pytest.raises(ValueRangeError, match="negative diagonal"):
        simplex_qp(-H, f)
    assert simplex_qp(H, f[:0]).shape == (0, 4)
