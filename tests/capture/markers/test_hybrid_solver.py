"""The hybrid solve: the markers' own weights where nothing is predicted, the right optimum where something is."""

from typing import Any

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Take, Track
from torchface.capture import HybridSolver, MarkerSolver
from torchface.capture.markers import gamma_curves
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.optim import box_qp
from torchface.optim.box_checks import default_tolerance


@pytest.fixture(scope="module")
def hybrid(small_rig: BlendshapeRig, small_attachment: Attachment) -> HybridSolver:
    return HybridSolver(MarkerSolver(small_rig.double(), small_attachment))


def seen(hybrid: HybridSolver, frames: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    weights = torch.rand(frames, len(hybrid.names), generator=generator, dtype=torch.float64)
    points = hybrid.markers.rest.double() + torch.einsum("mcn,bn->bmc", hybrid.markers.basis.double(), weights)
    return points + 0.3 * torch.randn(points.shape, generator=generator, dtype=torch.float64), weights


def test_frames_without_gamma_are_the_marker_solve_bit_for_bit(hybrid: HybridSolver) -> None:
    markers, truth = seen(hybrid, 12)
    gamma = torch.zeros_like(truth)
    gamma[3:6, 2] = 4.0
    weights, alone = hybrid(markers, truth, gamma), hybrid.markers(markers)
    still = (gamma == 0).all(1)
    assert torch.equal(weights[still], alone[still])
    assert not torch.equal(weights[~still], alone[~still])


def test_the_optimum_of_the_whole_energy(hybrid: HybridSolver) -> None:
    markers, truth = seen(hybrid, 6)
    markers[2, :7] = torch.nan
    gamma = 4 * torch.rand(truth.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    weights = hybrid(markers, truth, gamma)
    energy = hybrid.energy(markers, truth, gamma)
    gradient = torch.bmm(energy.H, weights[..., None])[..., 0] + energy.f
    assert float((weights - (weights - gradient).clamp(0, 1)).abs().max()) < 1e-9


def test_a_strong_pull_wins_and_leaves_the_others_to_the_markers(hybrid: HybridSolver) -> None:
    markers, truth = seen(hybrid, 8)
    predicted, gamma = torch.full_like(truth, torch.nan), torch.zeros_like(truth)
    predicted[:, 4], gamma[:, 4] = 0.25, 1e9
    weights = hybrid(markers, predicted, gamma)
    assert torch.allclose(weights[:, 4], torch.tensor(0.25, dtype=torch.float64), atol=1e-6)


def test_gradients_agree_with_finite_differences(hybrid: HybridSolver) -> None:
    markers, truth = seen(hybrid, 2)
    gamma = torch.full_like(truth, 2.0)
    predicted = (0.8 * truth + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: hybrid(markers, p, gamma), (predicted,), eps=1e-5, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_solves_stop_at_the_tolerance_of_the_markers(
    hybrid: HybridSolver, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    markers, truth = seen(hybrid, 3)
    markers[1, :5] = torch.nan
    asked: list[float] = []

    def watched(H: Tensor, f: Tensor, lower: Any, upper: Any, start: Tensor, tolerance: float) -> Tensor:
        asked.append(tolerance)
        return box_qp(H, f, lower, upper, start, tolerance)

    for module in ("markers.marker_solver", "corrective_energy"):
        monkeypatch.setattr(f"torchface.capture.{module}.box_qp", watched)
    hybrid(markers.to(dtype), truth.to(dtype), torch.ones_like(truth).to(dtype))
    assert asked == 2 * [default_tolerance(dtype)]


def test_gamma_fades_in_and_out_within_its_bounds() -> None:
    active = torch.zeros(80, 2, dtype=torch.bool)
    active[30:50, 0] = True
    gamma = gamma_curves(active)
    assert float(gamma.min()) == 0.0
    assert float(gamma.max()) == 4.0
    assert not gamma[:, 1].any()
    assert not gamma[:22, 0].any()
    assert not gamma[58:, 0].any()
    assert float(gamma[:, 0].diff().abs().max()) < 1.5  # a step of 4 without the filter


def test_takes_match_by_name(hybrid: HybridSolver) -> None:
    markers, truth = seen(hybrid, 5)
    take = Take(60.0, markers=Track(hybrid.markers.labels, markers))
    names = (hybrid.names[7], hybrid.names[1])
    predicted = Track(names, truth[:, [7, 1], None])
    gamma = Track(names, torch.full((5, 2, 1), 3.0, dtype=torch.float64))
    solved = hybrid.solve_take(take, predicted, gamma)
    dense = torch.zeros_like(truth)
    dense[:, [7, 1]] = 3.0
    assert torch.equal(solved.weights.values[..., 0], hybrid(markers, truth, dense))
    with pytest.raises(NameMismatchError, match="found wing"):
        hybrid.solve_take(take, Track(("wing",), predicted.values[:, :1]), Track(("wing",), gamma.values[:, :1]))
    with pytest.raises(ShapeError, match="5 frames of markers, 4 of predictions"):
        hybrid.solve_take(take, predicted.frames(slice(4)), gamma)


def test_bad_input(hybrid: HybridSolver) -> None:
    markers, truth = seen(hybrid, 3)
    with pytest.raises(ValueRangeError, match="gamma"):
        hybrid(markers, truth, -torch.ones_like(truth))
    with pytest.raises(ValueRangeError, match="predicted"):
        hybrid(markers, truth + 2, torch.ones_like(truth))
    with pytest.raises(ShapeError, match="expected \\(3, 12\\)"):
        hybrid(markers, truth[:2], torch.ones_like(truth))
