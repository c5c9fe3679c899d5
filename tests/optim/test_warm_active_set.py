"""A single program solved by its held set: the optimum, from any start, also where the sets do not settle."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.optim import warm_active_set
from torchface.optim.warm_active_set import solve_from_active_set


def program(seed: int, size: int, rank: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """H of a rank and a start, in [0,1] but for the last variable, which is free."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randn(rank, size, generator=generator, dtype=torch.float64)
    # Scales as far apart as weights and millimetres are.
    rows = rows * 10 ** torch.linspace(-2, 2, size, dtype=torch.float64)
    H = rows.T @ rows
    f = -(H @ torch.randn(size, generator=generator, dtype=torch.float64))
    lower, upper = torch.zeros(size, dtype=torch.float64), torch.ones(size, dtype=torch.float64)
    lower[-1], upper[-1] = -torch.inf, torch.inf
    return H, f, lower, upper, torch.rand(size, generator=generator, dtype=torch.float64).round(decimals=0)


def off_optimum(H: Tensor, f: Tensor, lower: Tensor, upper: Tensor, x: Tensor) -> Tensor:
    """Karush, Kuhn and Tucker's conditions, in the variables' own scales."""
    aim = x - (H @ x + f) / H.diagonal()
    return (x - torch.minimum(torch.maximum(aim, lower), upper)).abs().max()


@settings(max_examples=40)
@given(st.integers(0, 2**31), st.integers(1, 30))
def test_the_optimum_from_any_start(seed: int, size: int) -> None:
    H, f, lower, upper, start = program(seed, size, 2 * size)
    x = solve_from_active_set(H, f, lower, upper, start, 1e-9)
    assert bool((x >= lower).all() & (x <= upper).all())
    assert float(off_optimum(H, f, lower, upper, x)) < 1e-7


def test_a_start_at_the_optimum_stays() -> None:
    H, f, lower, upper, start = program(3, 20, 40)
    found = solve_from_active_set(H, f, lower, upper, start, 1e-9)
    torch.testing.assert_close(solve_from_active_set(H, f, lower, upper, found, 1e-9), found, rtol=0, atol=1e-10)


def test_singular_programs_and_sets_that_do_not_settle_are_solved_too(monkeypatch: pytest.MonkeyPatch) -> None:
    H, f, lower, upper, start = program(5, 12, 6)
    x = solve_from_active_set(H, f, lower, upper, start, 1e-6)
    assert float(off_optimum(H, f, lower, upper, x)) < 1e-5
    H, f, lower, upper, start = program(7, 20, 40)
    wanted = solve_from_active_set(H, f, lower, upper, start, 1e-9)
    monkeypatch.setattr(warm_active_set, "_CHANGES", 0)
    torch.testing.assert_close(solve_from_active_set(H, f, lower, upper, start, 1e-9), wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"tolerance": float("nan")}, "tolerance: found nan"),
        ({"tolerance": -1.0}, "tolerance: found -1"),
        ({"iterations": -3}, "iterations: found -3"),
        ({"iterations": 2.5}, "iterations: found 2.5"),
        ({"lower": torch.full((4,), torch.nan)}, "lower holds NaN"),
        ({"lower": torch.full((4,), 2.0)}, "lower 2.0 above upper 1.0"),
    ],
)
def test_settings_and_bounds_are_checked(changes: dict[str, Tensor | float], says: str) -> None:
    H, f, _, _, start = program(0, 4, 8)
    given = {"lower": torch.zeros(4), "upper": torch.ones(4), "tolerance": 1e-9, "iterations": 50, **changes}
    with pytest.raises(ValueRangeError, match=says):
        solve_from_active_set(H, f, start=start, **given)  # type: ignore[arg-type]
