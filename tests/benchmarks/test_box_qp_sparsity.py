"""The sparsity experiment of the thesis's figure 74 on real takes, and what the rule for the weight gives."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from planted.sparsity_rule import sparsity_by_rule
from torchface import Attachment, BlendshapeRig
from torchface.capture import MarkerSolver
from torchface.capture.markers import observability
from torchface.capture.markers.marker_solver import SPARSITY
from torchface.capture.markers.take_smoothing import with_sparsity


@dataclass(frozen=True)
class Trial:
    """A solve at one sparsity, means over the frames; errors are root mean squares."""

    sparsity: float
    active: float
    weight_sum: float
    marker_error: float
    weight_error: float

    @staticmethod
    def of(solver: MarkerSolver, markers: Tensor, truth: Tensor) -> "Trial":
        weights = solver(markers)
        return Trial(
            float(solver.sparsity),
            float((weights > 0.01).sum(-1).double().mean()),
            float(weights.sum(-1).mean()),
            float(solver.squared_distance(markers, weights).mean()) ** 0.5,
            float((weights - truth).square().mean().sqrt()),
        )


@pytest.mark.real
@pytest.mark.parametrize("count", [100, 50])
def test_sparsity_on_real_takes(real_capture: tuple[BlendshapeRig, Attachment, list[Tensor]], count: int) -> None:
    rig, attachment, takes = real_capture
    layout = attachment.select((attachment.labels or ())[:count])
    solver = MarkerSolver(rig, layout)
    truth = torch.cat(takes)
    points = solver.rest + torch.einsum("mcn,bn->bmc", solver.basis, truth)
    points = points + 0.3 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    by_rule = [sparsity_by_rule(solver, take) for take in points.split([len(take) for take in takes])]
    sparsities = [0.0, 0.003, SPARSITY, 0.03, 0.1, 0.3, 1.0]
    trials = [Trial.of(with_sparsity(solver, sparsity), points, truth) for sparsity in sparsities]

    print(f"\n{observability(solver)}")
    print(f"{count} markers, {len(truth)} real frames, 0.3 mm noise; by the rule: "
          + ", ".join(f"{beta:.3f}" for beta in by_rule))  # fmt: skip
    true_active = float((truth > 0.01).sum(-1).double().mean())
    print(f"{'sparsity':>9} {'active':>7} {'sum w':>6} {'markers mm':>11} {'weights':>8}   "
          f"(true: {true_active:.1f} active, sum {float(truth.sum(-1).mean()):.2f})")  # fmt: skip
    for trial in trials:
        print(f"{trial.sparsity:9.3f} {trial.active:7.1f} {trial.weight_sum:6.2f} "
              f"{trial.marker_error:11.3f} {trial.weight_error:8.4f}")  # fmt: skip

    chosen = trials[sparsities.index(SPARSITY)]
    assert chosen.active < trials[0].active
    assert chosen.weight_error < trials[0].weight_error
