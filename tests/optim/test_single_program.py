"""BoxQP a frame at a time: compiled or in NumPy, the optimum of the batch, whatever it starts from."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torch import Tensor

from torchface.optim import BoxQP, box_qp
from torchface.optim.compiled_program import compiled_solver_installed
from torchface.optim.prepared_program import PreparedProgram

SIZE = 30


@pytest.fixture(scope="module")
def program() -> tuple[Tensor, Tensor, Tensor]:
    """H that overlapping shapes give, f of frames in order, and the solutions of the batch."""
    generator = torch.Generator().manual_seed(0)
    basis = torch.randn(90, SIZE, generator=generator, dtype=torch.float64).cumsum(1)
    weights = torch.rand(40, SIZE, generator=generator, dtype=torch.float64).cumsum(0).sin()
    H = basis.T @ basis / 90 + 1e-3 * torch.eye(SIZE, dtype=torch.float64)
    f = -weights @ H
    return H, f, box_qp(H, f)


@pytest.fixture(params=["compiled", "numpy", "numpy that finds none"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each of the ways of a single problem, alone."""
    if request.param == "compiled":
        if not compiled_solver_installed():
            pytest.skip("daqp is not installed")
        monkeypatch.setattr(
            "torchface.optim.single_program.SingleProgram.solve", lambda *_: pytest.fail("not compiled")
        )
        return request.param
    monkeypatch.setattr("torchface.optim.prepared_program.compiled_solver_installed", lambda: False)
    if request.param != "numpy":
        monkeypatch.setattr("torchface.optim.single_program.SingleProgram.solve", lambda *_: None)
    return request.param


@pytest.mark.usefixtures("way")
def test_frames_one_at_a_time_are_those_of_the_batch(program: tuple[Tensor, Tensor, Tensor]) -> None:
    H, f, whole = program
    qp, coarse = BoxQP(H), BoxQP(H.float())
    before = strange = None
    for row in range(12):
        before = qp(f[row : row + 1], before)
        torch.testing.assert_close(before, whole[row : row + 1], rtol=0, atol=1e-8)
        strange = coarse(f[row : row + 1].float(), whole[-1 - row : len(whole) - row].float())
        assert strange.dtype == torch.float32
        assert float(strange.min()) >= 0
        assert float(strange.max()) <= 1
        torch.testing.assert_close(strange.double(), whole[row : row + 1], rtol=0, atol=2e-3)
    torch.testing.assert_close(qp(f[:5]), whole[:5], rtol=0, atol=1e-8)
    torch.testing.assert_close(qp(f[5:6]), whole[5:6], rtol=0, atol=1e-8)


@pytest.mark.usefixtures("way")
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


@pytest.mark.parametrize("way", [False, True])
def test_no_number_and_no_tolerance_are_left_to_the_batch(
    program: tuple[Tensor, Tensor, Tensor], way: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    H, f, _ = program
    if way and not compiled_solver_installed():
        pytest.skip("daqp is not installed")
    monkeypatch.setattr("torchface.optim.prepared_program.compiled_solver_installed", lambda: way)
    alone = PreparedProgram.of(H, 0.0, 1.0)
    assert alone.solved_singly(torch.full((1, SIZE), torch.nan, dtype=torch.float64), None, 1e-9) is None
    assert alone.solved_singly(f[:1], torch.full_like(f[:1], torch.nan), 0.0) is None
    assert alone.solved_singly(f[:1], None, 0.0) is None
    assert alone.solved_singly(f[:1], None, 1e-9) is not None
