"""Loops over small systems take one thread of BLAS, and leave the rest of the program its threads."""

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from torchface.optim import box_qp
from torchface.optim import free_variables as free_variables_module
from torchface.optim.blas_threads import one_blas_thread


def threads() -> set[int]:
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_threads_come_back() -> None:
    with threadpool_limits(2, user_api="blas"):
        with one_blas_thread():
            assert threads() == {1}
        with one_blas_thread(53):
            assert threads() == {2}
        assert threads() == {2}


def test_large_systems_are_solved_by_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, solution = set[int](), free_variables_module._solution

    def watched(*given: object) -> object:
        seen.update(threads())
        return solution(*given)

    monkeypatch.setattr(free_variables_module, "_solution", watched)
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(300, 100, generator=generator).double()
    with threadpool_limits(2, user_api="blas"):
        box_qp(rows.T @ rows, torch.randn(64, 100, generator=generator).double())
        assert threads() == {2}
    assert seen == {1}
