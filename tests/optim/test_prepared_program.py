"""DAQP one problem at a time: the optimum of the batch, whatever it was called with before."""

import copy
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.optim import BoxQP, box_qp
from torchface.optim.prepared_program import OneByOne, PreparedProgram

SIZE = 30


@pytest.fixture(scope="module")
def program() -> tuple[Tensor, Tensor, Tensor]:
    """H that overlapping shapes give, f of frames in order, and the solutions of a batch."""
    generator = torch.Generator().manual_seed(0)
    basis = torch.randn(90, SIZE, generator=generator, dtype=torch.float64).cumsum(1)
    weights = torch.rand(40, SIZE, generator=generator, dtype=torch.float64).cumsum(0).sin()
    H = basis.T @ basis / 90 + 1e-3 * torch.eye(SIZE, dtype=torch.float64)
    f = -weights @ H
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PreparedProgram, "_few", -1)
        return H, f, box_qp(H, f)


def test_frames_one_at_a_time_are_those_of_the_batch(program: tuple[Tensor, Tensor, Tensor]) -> None:
    H, f, whole = program
    qp, coarse = BoxQP(H), BoxQP(H.float())
    before = None
    for row in range(12):
        before = qp(f[row : row + 1], before)
        torch.testing.assert_close(before, whole[row : row + 1], rtol=0, atol=1e-8)
        single = coarse(f[row : row + 1].float())
        assert single.dtype == torch.float32
        assert float(single.min()) >= 0
        assert float(single.max()) <= 1
        torch.testing.assert_close(single.double(), whole[row : row + 1], rtol=0, atol=2e-3)
    torch.testing.assert_close(qp(f[:5]), whole[:5], rtol=0, atol=1e-8)


def test_several_problems_give_the_same_bits_again(program: tuple[Tensor, Tensor, Tensor]) -> None:
    H, f, _ = program
    qp = BoxQP(H)
    first = qp(f)
    qp(f[:7].flip(0))
    assert torch.equal(qp(f), first)


def test_what_it_finds_is_checked_and_what_it_misses_is_solved_as_a_batch(
    program: tuple[Tensor, Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    H, f, whole = program
    one_by_one = OneByOne(H, torch.zeros(SIZE).double(), torch.ones(SIZE).double())
    strange = f[:4].clone()
    strange[1], strange[2] = torch.nan, 1e30
    assert one_by_one.solve(strange.numpy(), 1e-9)[1].tolist() == [1, 2]
    assert len(one_by_one.solve(f[:4].numpy(), 0.0)[1])

    def misled(self: OneByOne, row: int, slope: object, cold: bool) -> float:
        return 0.5

    monkeypatch.setattr(OneByOne, "_minimiser", misled)
    assert one_by_one.solve(f[:4].numpy(), 1e-9)[1].tolist() == [0, 1, 2, 3]
    torch.testing.assert_close(BoxQP(H)(f), whole, rtol=0, atol=1e-8)
    with pytest.raises(ValueRangeError, match=r"f holds NaN or infinite entries in rows \[1\]"):
        BoxQP(H)(strange)


@pytest.mark.parametrize("rows_left_out", [0.3, 0.6])
@pytest.mark.parametrize("upper", [1.0, float("inf")])
def test_problems_of_an_h_each_are_solved_however_much_alike_they_are(rows_left_out: float, upper: float) -> None:
    generator = torch.Generator().manual_seed(1)
    basis = torch.randn(90, SIZE, generator=generator, dtype=torch.float64)
    seen = torch.rand(60, 90, generator=generator) > rows_left_out
    rows = basis * seen[..., None] * 10.0 ** torch.arange(60).remainder(4)[:, None, None]  # not of one scale either
    H = rows.mT @ rows + 1e-3 * torch.eye(SIZE, dtype=torch.float64)
    f = -(torch.randn(60, SIZE, generator=generator, dtype=torch.float64)[:, None] @ H)[:, 0]
    bounds = torch.zeros(SIZE).double(), torch.full((SIZE,), upper).double()
    expected, left = OneByOne(H, *bounds).solve(f.numpy(), 1e-9)
    assert not len(left)
    torch.testing.assert_close(box_qp(H, f, 0.0, upper), torch.from_numpy(expected), rtol=0, atol=1e-8)


def test_bounds_that_change_are_kept(program: tuple[Tensor, Tensor, Tensor]) -> None:
    H, f, _ = program
    qp = BoxQP(H, -torch.inf, 0.5)
    torch.testing.assert_close(qp(f[:1]), box_qp(H, f[:20], -torch.inf, 0.5)[:1], rtol=0, atol=1e-8)
    qp.lower.fill_(0.25)
    torch.testing.assert_close(qp(f[:1]), box_qp(H, f[:20], 0.25, 0.5)[:1], rtol=0, atol=1e-8)


def test_a_program_is_copied_and_pickled_without_what_is_compiled(program: tuple[Tensor, Tensor, Tensor]) -> None:
    H, f, whole = program
    qp = BoxQP(H)
    qp(f[:1])
    for other in (copy.deepcopy(qp), pickle.loads(pickle.dumps(qp))):
        torch.testing.assert_close(other(f[1:2]), whole[1:2], rtol=0, atol=1e-8)


@settings(max_examples=25)
@given(st.integers(0, 2**31), st.integers(1, 30), st.booleans())
def test_the_optimum_of_scales_as_far_apart_as_weights_and_millimetres(seed: int, size: int, singular: bool) -> None:
    """Karush, Kuhn and Tucker's conditions, in the variables' own scales; the last variable is free."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randn(max(1, size // 2) if singular else 2 * size, size, generator=generator, dtype=torch.float64)
    rows = rows * 10 ** torch.linspace(-2, 2, size, dtype=torch.float64)
    H = rows.T @ rows
    f = -(torch.randn(3, size, generator=generator, dtype=torch.float64) @ H)
    lower, upper = torch.zeros(size, dtype=torch.float64), torch.ones(size, dtype=torch.float64)
    lower[-1], upper[-1] = -torch.inf, torch.inf
    x = box_qp(H, f, lower, upper, tolerance=1e-7)
    assert bool((x >= lower).all() & (x <= upper).all())
    aim = x - (x @ H + f) / H.diagonal()
    assert float(((x - aim.clamp(lower, upper)).abs() / (1 + x.abs())).max()) < 1e-6
