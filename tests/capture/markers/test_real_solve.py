"""The solve on a real rig of 53 shapes, moved by six real takes."""

import pytest
import torch
from torch import Tensor

from planted.sparsity_rule import sparsity_by_rule
from torchface import Attachment, BlendshapeRig
from torchface.capture import MarkerSolver
from torchface.capture.markers import observability
from torchface.capture.markers.marker_solver import SPARSITY
from torchface.optim import box_qp

Capture = tuple[BlendshapeRig, Attachment, list[Tensor]]


def noisy_markers(solver: MarkerSolver, weights: Tensor, missing: float = 0.0) -> Tensor:
    """What 0.3 mm of noise leaves of the true markers, float64."""
    generator = torch.Generator().manual_seed(0)
    points = solver.rest.double() + torch.einsum("mcn,bn->bmc", solver.basis.double(), weights.double())
    points = points + 0.3 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    hidden = torch.rand(points.shape[:2], generator=generator) < missing
    return torch.where(hidden[..., None], torch.nan, points)


def duality_gap(gradient: Tensor, x: Tensor) -> Tensor:
    """How far x can be from optimal at most: the objective is convex, so it lies above its tangent over the box."""
    return torch.where(gradient > 0, gradient * x, gradient * (x - 1)).sum(-1)


def step(H: Tensor, f: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient, and the projected-gradient residual in the metric of H's diagonal."""
    gradient = f + (x @ H if H.ndim == 2 else torch.bmm(H, x[..., None])[..., 0])
    moved = (x - gradient / H.diagonal(dim1=-2, dim2=-1)).clamp(0, 1)
    return gradient, (x - moved).abs().amax(-1)


@pytest.mark.real
@pytest.mark.parametrize(("missing", "every"), [(0.0, 5), (0.3, 20)])
@pytest.mark.parametrize("sparsity", [0.0, SPARSITY])
def test_every_frame_is_optimal(real_capture: Capture, missing: float, every: int, sparsity: float) -> None:
    rig, attachment, takes = real_capture
    solver = MarkerSolver(rig, attachment, sparsity=sparsity, ridge=0.0)
    markers = noisy_markers(solver, torch.cat(takes)[::every], missing)
    energy = solver.energy(markers)
    H, f = energy.H, energy.f.expand(len(markers), -1)

    x = box_qp(H, f)
    least = energy.value(x)
    gradient, residual = step(H, f, x)
    assert residual.max() <= 1e-8
    # Rigorous: no other solver's word is needed for it.
    assert (duality_gap(gradient, x) / least).max() <= 1e-6

    single = box_qp(H.float(), f.float()).double()
    _, residual = step(H.float().double(), f.float().double(), single)
    assert residual.max() <= 1e-4
    assert ((energy.value(single) - least) / least).max() <= 1e-5
    # The module on single precision markers: H and f are formed in double precision, so its gap is no larger.
    assert ((energy.value(solver(markers.float()).double()) - least) / least).max() <= 1e-5


@pytest.mark.real
def test_the_default_sparsity_is_the_rule_s_order_of_magnitude(real_capture: Capture) -> None:
    rig, attachment, takes = real_capture
    solver = MarkerSolver(rig, attachment)
    by_rule = [sparsity_by_rule(solver, noisy_markers(solver, take[::10]).float()) for take in takes]
    assert all(SPARSITY < beta < 10 * SPARSITY for beta in by_rule)


@pytest.mark.real
def test_gaze_is_what_face_markers_cannot_tell(real_capture: Capture) -> None:
    rig, attachment, _ = real_capture
    report = observability(MarkerSolver(rig, attachment))
    assert report.rank == 53
    assert report.visible < 53
    # ICT's gaze shapes move the lids a little and nothing else of the skin.
    assert {"eyeLookIn_L", "eyeLookOut_L", "eyeLookIn_R", "eyeLookOut_R"} <= {*report.unseen, *report.ambiguous}
    assert "jawOpen" not in {*report.unseen, *report.ambiguous}
