"""The pieces of the exact end: masked solves, Newton steps, the fixed point of splitting."""

import pytest
import torch

from torchface.errors import ValueRangeError
from torchface.optim.active_set import primal_dual_active_set, projected_newton
from torchface.optim.box_problem import BoxProblem, metric
from torchface.optim.free_variables import solve_free
from torchface.optim.operator_splitting import prepare_splitting, splitting_steps, start_splitting


def problem(variables: int = 12, problems: int = 30, seed: int = 0) -> BoxProblem:
    generator = torch.Generator().manual_seed(seed)
    A = torch.randn(2 * variables, variables, generator=generator, dtype=torch.float64)
    f = 5 * torch.randn(problems, variables, generator=generator, dtype=torch.float64)
    H = (
        A.T
        @ A
        * torch.logspace(-2, 2, variables, dtype=torch.float64)
        .sqrt()
        .outer(torch.logspace(-2, 2, variables, dtype=torch.float64).sqrt())
    )
    zeros, ones = f.new_zeros(variables), f.new_ones(variables)
    return BoxProblem.of(H, f, zeros, ones)


def test_a_masked_solve_is_the_solve_of_the_block() -> None:
    given = problem()
    free = torch.rand(30, 12, generator=torch.Generator().manual_seed(1)) < 0.6
    solved = solve_free(given.H, given.diagonal, free, given.f)
    for row in range(30):
        ids = free[row].nonzero()[:, 0]
        block = torch.linalg.solve(given.H[ids][:, ids], given.f[row, ids])
        torch.testing.assert_close(solved[row, ids], block, rtol=1e-8, atol=1e-10)
        assert (solved[row][~free[row]] == 0).all()


def test_damping_adds_to_the_metric() -> None:
    given = problem()
    free = torch.ones(30, 12, dtype=torch.bool)
    damping = torch.linspace(0.1, 2, 30, dtype=torch.float64)
    solved = solve_free(given.H, given.diagonal, free, given.f, damping)
    lifted = given.H + torch.diag_embed(damping[:, None] * metric(given.H))
    torch.testing.assert_close(solved, torch.linalg.solve(lifted, given.f), rtol=1e-8, atol=1e-10)


def test_a_masked_solve_with_an_h_each_and_of_singular_blocks() -> None:
    given = problem()
    free = torch.rand(30, 12, generator=torch.Generator().manual_seed(1)) < 0.6
    free[3], free[4] = False, True
    many = given.H * torch.linspace(0.5, 2, 30, dtype=torch.float64)[:, None, None]
    alone = [solve_free(many[i], metric(many[i]), free[i : i + 1], given.f[i : i + 1]) for i in range(30)]
    torch.testing.assert_close(solve_free(many, metric(many), free, given.f), torch.cat(alone))
    ones = torch.ones(12, 12, dtype=torch.float64)
    solved = solve_free(ones, metric(ones), free, ones[:1].expand(30, 12))
    torch.testing.assert_close(solved.sum(-1), free.any(-1).double(), rtol=0, atol=1e-6)


def test_sets_that_are_nearly_right_settle_at_the_optimum_and_others_are_given_back() -> None:
    given = problem(problems=300)
    optimum = projected_newton(given, torch.zeros(300, 12, dtype=torch.float64), 1e-12)
    start = optimum.clone()
    start[:, 5] = (start[:, 5] <= 0).double()  # one variable of each set is wrong
    found, gradient = primal_dual_active_set(given, start)
    torch.testing.assert_close(gradient, given.gradient(found), rtol=1e-9, atol=1e-9)
    settled = given.residual(found) <= 1e-9
    assert 0.6 < settled.double().mean() < 1
    assert torch.equal(found[~settled], start[~settled])
    torch.testing.assert_close(found[settled], optimum[settled], rtol=0, atol=1e-9)


def test_newton_steps_reach_the_optimum_from_anywhere() -> None:
    given = problem(problems=300)
    start = torch.rand(300, 12, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    x = projected_newton(given, start, 1e-11)
    assert given.residual(x).max() <= 1e-10
    other = projected_newton(given, 1 - start, 1e-11)
    torch.testing.assert_close(x, other, rtol=0, atol=1e-8)


def test_newton_steps_never_raise_the_objective() -> None:
    given = problem(problems=300, seed=4)
    x = torch.rand(300, 12, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    for _ in range(4):
        following = projected_newton(given, x, 1e-11, iterations=1)
        assert (given.objective(following) <= given.objective(x) + 1e-9).all()
        x = following


def test_the_optimum_is_where_splitting_rests() -> None:
    given = problem()
    factors = prepare_splitting(given.H)
    state = splitting_steps(given, factors, start_splitting(given, None), 2000)
    assert given.residual(state.z).max() <= 1e-10
    again = splitting_steps(given, factors, state, 1)
    torch.testing.assert_close(again.z, state.z, rtol=0, atol=1e-11)
    torch.testing.assert_close(again.t, state.t, rtol=0, atol=1e-9)


def test_splitting_with_an_h_each_is_splitting_of_each() -> None:
    given = problem()
    H = given.H * torch.linspace(0.5, 2, 30, dtype=torch.float64)[:, None, None]
    many = BoxProblem.of(H, given.f, given.lower, given.upper)
    together = splitting_steps(many, prepare_splitting(H), start_splitting(many, None), 7).z
    for row in (0, 13, 29):
        one = BoxProblem.of(H[row], given.f[row : row + 1], given.lower, given.upper)
        alone = splitting_steps(one, prepare_splitting(H[row]), start_splitting(one, None), 7).z
        torch.testing.assert_close(together[row : row + 1], alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize("tolerance", [float("nan"), float("inf"), -1e-9])
def test_newton_steps_need_a_tolerance(tolerance: float) -> None:
    given = problem(problems=2)
    with pytest.raises(ValueRangeError, match="tolerance: found"):
        projected_newton(given, torch.zeros(2, 12, dtype=torch.float64), tolerance)


@pytest.mark.parametrize(("rho", "relaxation"), [(0.0, 1.5), (float("nan"), 1.5), (0.1, 0.0), (0.1, 2.5)])
def test_splitting_needs_a_metric_and_a_relaxation(rho: float, relaxation: float) -> None:
    with pytest.raises(ValueRangeError, match="prepare_splitting: r"):
        prepare_splitting(torch.eye(3, dtype=torch.float64), rho, relaxation)
