"""The sparsity experiment of the thesis's figure 74 on real takes, and what the rule for the weight gives."""

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import pytest
import torch
from torch import Tensor

from planted.sparsity_rule import sparsity_by_rule
from torchface import Attachment, BlendshapeRig
from torchface.capture import MarkerSolver
from torchface.capture.markers import observability
from torchface.capture.markers.marker_solver import SPARSITY
from torchface.capture.markers.take_smoothing import with_sparsity

matplotlib.use("Agg")
OUT = Path(__file__).resolve().parents[2] / "out" / "benchmarks"


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

    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    counts, errors, frame = figure.subplots(1, 3)
    shown = [max(trial.sparsity, 1e-3) for trial in trials]
    counts.semilogx(shown, [trial.active for trial in trials], "o-")
    counts.axhline(true_active, linestyle="--", color="gray", label="true")
    counts.set(xlabel="sparsity, mm² a marker (left: none)", ylabel="active shapes")
    errors.semilogx(shown, [trial.marker_error for trial in trials], "o-", label="markers, mm")
    errors.semilogx(shown, [trial.weight_error for trial in trials], "s-", label="weights")
    errors.set(xlabel="sparsity, mm² a marker (left: none)", ylabel="root mean square error")
    for axes in (counts, errors):
        axes.axvspan(min(by_rule), max(by_rule), alpha=0.2, color="C2", label="the rule, six takes")
        axes.legend()
    row = int(truth.sum(-1).argmax())
    without, with_it = (
        MarkerSolver(rig, layout, sparsity=s)(points[row : row + 1])[0].numpy() for s in (0.0, SPARSITY)
    )
    places = range(len(rig.names))
    frame.bar(places, without, width=1.0, color="C1", label="without")
    frame.bar(places, with_it, width=0.5, color="C0", label="with")
    frame.plot(places, truth[row].numpy(), "k.", markersize=4, label="true")
    frame.set(xlabel="shape", ylabel="weight", title="the busiest frame")
    frame.legend()
    OUT.mkdir(parents=True, exist_ok=True)
    figure.savefig(OUT / f"sparsity_{count}_markers.png", dpi=120)

    chosen = trials[sparsities.index(SPARSITY)]
    assert chosen.active < trials[0].active
    assert chosen.weight_error < trials[0].weight_error
