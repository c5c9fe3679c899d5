"""What a solver prepares follows its state, whichever way that was changed."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from torchface import Attachment, BlendshapeRig
from torchface.capture import HelmetSolver, HybridSolver, MarkerSolver
from torchface.errors import ShapeError, TraceError

Solve = Callable[[nn.Module, Tensor], Tensor]


def helmet_weights(solver: nn.Module, markers: Tensor) -> Tensor:
    return solver(markers)[0]


def hybrid_weights(solver: nn.Module, markers: Tensor) -> Tensor:
    pull = markers.new_full((len(markers), 12), 0.5)
    return solver(markers, pull, 2 * pull)


SOLVERS: dict[str, tuple[Callable[..., nn.Module], Solve]] = {
    "markers": (MarkerSolver, lambda solver, markers: solver(markers)),
    "helmet": (HelmetSolver, helmet_weights),
    "hybrid": (lambda *parts: HybridSolver(MarkerSolver(*parts)), hybrid_weights),
}


def test_weights_are_differentiable_in_the_penalties(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    truth = torch.rand(3, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    markers = small_attachment.on(small_rig.neutral.faces, small_rig.double()(truth))

    def solve(sparsity: Tensor, ridge: Tensor) -> Tensor:
        return MarkerSolver(small_rig, small_attachment, sparsity=sparsity, ridge=ridge)(markers)

    penalties = (
        torch.tensor(0.5, dtype=torch.float64, requires_grad=True),
        torch.tensor(0.2, dtype=torch.float64, requires_grad=True),
    )
    assert torch.autograd.gradcheck(solve, penalties, eps=1e-6, atol=1e-6)
    assert all(part.abs().max() > 1e-2 for part in torch.autograd.grad(solve(*penalties).sum(), penalties))


def test_a_penalty_is_learned_and_saved(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    """Several steps through one solver: no graph is kept from the step before."""
    rig = small_rig.float()
    truth = 0.3 * torch.rand(8, 12, generator=torch.Generator().manual_seed(1))
    markers = small_attachment.on(rig.neutral.faces, rig(truth))
    solver = MarkerSolver(
        rig,
        small_attachment,
        sparsity=nn.Parameter(torch.tensor(1.0)),
        ridge=nn.Parameter(torch.tensor(0.5)),
    )
    assert {name for name, _ in solver.named_parameters()} == {"sparsity", "ridge"}
    errors = []
    optimizer = torch.optim.SGD(solver.parameters(), lr=40.0)
    for _ in range(8):  # gradient descent is a sequence
        error = (solver(markers) - truth).square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        with torch.no_grad():
            for penalty in solver.parameters():
                penalty.clamp_(min=1e-4)
        errors.append(error.item())
    assert errors[-1] < 0.5 * errors[0]
    copy = MarkerSolver.from_config(solver.config)
    copy.load_state_dict(solver.state_dict())
    with torch.no_grad():  # few frames that ask for gradients are solved another way, which rounds otherwise
        assert torch.equal(copy(markers), solver(markers))
    assert solver.sparsity.item() < 0.9


def test_a_penalty_is_one_number(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    with pytest.raises(ShapeError, match=r"sparsity: found \(2,\), expected one number"):
        MarkerSolver(small_rig, small_attachment, sparsity=torch.ones(2))


def test_sites_are_learned_through_the_solve(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    """Gradients in the basis pass through H and f, as finite differences say."""
    truth = torch.rand(2, 12, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    markers = small_attachment.on(small_rig.neutral.faces, small_rig.double()(truth))
    solver = MarkerSolver(small_rig.double(), small_attachment, ridge=0.1)
    basis = solver.basis.clone()

    def solve(first: Tensor) -> Tensor:
        solver.basis = torch.cat([first[None], basis[1:]])
        return solver(markers)

    assert torch.autograd.gradcheck(solve, (basis[0].clone().requires_grad_(),), eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", SOLVERS)
def test_a_trace_is_refused(small_rig: BlendshapeRig, small_attachment: Attachment, kind: str) -> None:
    make, solve = SOLVERS[kind]
    solver = make(small_rig, small_attachment)
    markers = small_attachment.on(small_rig.neutral.faces, small_rig.vertices[None]).float()
    with pytest.raises(TraceError, match="torchface export solver"):
        torch.jit.trace(lambda seen: solve(solver, seen), markers)
