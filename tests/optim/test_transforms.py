"""The box QP under the transforms of torch.func: as a loop over it would be."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torchface.errors import TraceError
from torchface.optim import BoxQP, box_qp


def problems(*shape: int, seed: int = 0) -> Tensor:
    return 4 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 3


def hessians(*shape: int, seed: int = 1) -> Tensor:
    A = problems(*shape, 9, 5, seed=seed)
    return A.mT @ A + 0.1 * torch.eye(5, dtype=torch.float64)


def test_jacobians_are_those_of_autograd() -> None:
    f, H = problems(3, 5), hessians()
    qp = BoxQP(torch.nn.Parameter(H))
    assert bool(((qp(f) > 0) & (qp(f) < 1)).any(1).all())
    wanted = torch.autograd.functional.jacobian(qp, f)
    torch.testing.assert_close(torch.func.jacrev(qp)(f), wanted, rtol=0, atol=1e-9)
    torch.testing.assert_close(torch.func.jacfwd(qp)(f), wanted, rtol=0, atol=1e-9)

    def by_state(H: Tensor) -> Tensor:
        found = torch.func.functional_call(qp, {"H": H}, (f,))
        assert isinstance(found, Tensor)
        return found

    for parts in (H, hessians(3)):
        solved: Callable[[Tensor], Tensor] = by_state if parts.ndim == 2 else lambda H: box_qp(H, f)
        wanted = torch.autograd.functional.jacobian(lambda H: box_qp(H, f), parts)
        torch.testing.assert_close(torch.func.jacrev(solved)(parts), wanted, rtol=0, atol=1e-9)
    torch.testing.assert_close(qp(f), box_qp(H, f), rtol=0, atol=1e-9)  # nothing of the transforms stays behind


@pytest.mark.parametrize(("along_H", "along_f"), [(None, 0), (0, None), (0, 0), (None, 1)])
@pytest.mark.parametrize("own", [False, True], ids=["shared", "each"])
def test_a_mapped_call_is_a_loop(along_H: int | None, along_f: int | None, own: bool) -> None:
    H = hessians(*(() if along_H is None else (4,)), *((3,) if own else ()))
    f = problems(*(() if along_f is None else (4,)), 3, 5)
    f = f.movedim(0, 1) if along_f == 1 else f
    found = torch.func.vmap(box_qp, in_dims=(along_H, along_f))(H, f)
    one_H, one_f = H if along_H is None else H.unbind(along_H), f if along_f is None else f.unbind(along_f)
    looped = [box_qp(one_H if along_H is None else one_H[i], one_f if along_f is None else one_f[i]) for i in range(4)]
    torch.testing.assert_close(found, torch.stack(looped), rtol=0, atol=1e-9)


def test_gradients_of_each_sample_are_those_of_a_loop() -> None:
    qp, f = BoxQP(torch.nn.Parameter(hessians())), problems(6, 2, 5)

    def loss(state: dict[str, Tensor], f: Tensor) -> Tensor:
        found = torch.func.functional_call(qp, state, (f,))
        assert isinstance(found, Tensor)
        return (found * torch.arange(5.0).double()).sum()

    state = {"H": qp.H.detach()}
    found = torch.func.vmap(torch.func.grad(loss), in_dims=(None, 0))(state, f)["H"]
    looped = [torch.autograd.grad((qp(some) * torch.arange(5.0).double()).sum(), qp.H)[0] for some in f]
    torch.testing.assert_close(found, torch.stack(looped), rtol=0, atol=1e-9)
    assert float(found.abs().amax((1, 2)).min()) > 0


def test_derivatives_of_derivatives() -> None:
    """As finite differences of the first ones say, by H and by f; those of torch.func are the same."""
    H, f = hessians(), problems(3, 5)
    L = torch.linalg.cholesky(H)

    def solved(L: Tensor, f: Tensor) -> Tensor:
        return box_qp(L @ L.mT, f, tolerance=1e-13)

    given = L.clone().requires_grad_(), f.clone().requires_grad_()
    assert torch.autograd.gradgradcheck(solved, given, eps=1e-6, atol=1e-5)
    wanted = torch.autograd.functional.hessian(lambda f: solved(L, f).pow(3).sum(), f)
    assert float(wanted.abs().max()) > 1e-3
    for hessian in (torch.func.hessian, lambda loss: torch.func.jacrev(torch.func.jacrev(loss))):
        found = hessian(lambda f: solved(L, f).pow(3).sum())(f)
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-8)


def test_bounds_are_one_box() -> None:
    H, f = hessians(), problems(3, 5)
    with pytest.raises(TraceError, match="found bounds that vmap goes along"):
        torch.func.vmap(lambda upper: box_qp(H, f, 0.0, upper))(torch.ones(2, 5).double())
