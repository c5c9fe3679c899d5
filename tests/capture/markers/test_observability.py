"""The report names what was made invisible; sparsity does what the rule says."""

import math

import pytest
import torch

from planted.sparsity_rule import sparsity_by_rule
from torchface import Attachment, BlendshapeRig
from torchface.capture import MarkerSolver
from torchface.capture.markers import observability
from torchface.capture.markers.take_smoothing import with_sparsity


def with_shapes(rig: BlendshapeRig, **more: torch.Tensor) -> BlendshapeRig:
    return BlendshapeRig(rig.neutral, torch.cat([rig.deltas, torch.stack(list(more.values()))]), [*rig.names, *more])


def test_a_good_layout_sees_everything(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    solver = MarkerSolver(small_rig, small_attachment)
    report = observability(solver, noise=1e-3)
    assert (report.rank, report.visible, report.unseen, report.ambiguous) == (12, 12, (), ())
    singular = torch.linalg.svdvals(solver.basis.double().flatten(0, 1))
    assert report.condition == pytest.approx(float(singular[0] / singular[-1]))
    assert "40 markers see 12 of 12" in str(report)


def test_a_twin_an_unseen_shape_and_a_sum_are_named(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    # A vertex that no marker's triangle touches: what moves it alone is not seen.
    corners = small_rig.neutral.faces[small_attachment.triangles].unique().tolist()
    hidden = torch.zeros(len(small_rig.vertices), 3)
    hidden[next(i for i in range(225) if i not in corners), 2] = 5.0
    rig = with_shapes(small_rig, twin=small_rig.deltas[3] * 0.5, hidden=hidden)
    report = observability(MarkerSolver(rig, small_attachment), noise=1e-3)
    assert report.rank == 12
    assert report.condition == math.inf
    assert report.unseen == ("hidden",)
    assert set(report.ambiguous) == {"shape3", "twin"}
    (confusion,) = report.confusions
    assert set(confusion.names) == {"shape3", "twin"}
    # Half a weight on the shape is undone by minus a whole weight on its half-sized twin.
    parts = dict(zip(confusion.names, confusion.direction, strict=True))
    assert parts["twin"] / parts["shape3"] == pytest.approx(-2, abs=1e-4)
    assert "hidden" in str(report)


def test_fewer_equations_than_shapes(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    few = small_attachment.select(small_attachment.labels[:2])
    report = observability(MarkerSolver(small_rig, few), noise=1e-3)
    assert report.rank == 6
    assert report.visible <= 6
    assert len(report.confusions) + len(report.unseen) >= 6


def test_sparsity_trades_active_shapes_for_error(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(200, 12, generator=generator) * (torch.rand(200, 12, generator=generator) < 0.3)
    markers = small_attachment.on(small_rig.neutral.faces, small_rig.float()(truth))
    markers = markers + 2.0 * torch.randn(markers.shape, generator=generator)
    solver = MarkerSolver(small_rig, small_attachment)
    beta = sparsity_by_rule(solver, markers)
    solves = [with_sparsity(solver, sparsity) for sparsity in (0.0, beta, 10 * beta)]
    found = [solve(markers) for solve in solves]
    active = [float((weights > 0.01).sum(-1).double().mean()) for weights in found]
    squared = [float(solver.squared_distance(markers, weights).mean()) for weights in found]
    sums = [float(weights.sum(-1).mean()) for weights in found]
    assert active[0] > active[1] > active[2]
    assert squared[0] < squared[1] < squared[2]
    # The rule: without a penalty, the penalty of the weights would be the squared error.
    assert beta * sums[0] == pytest.approx(squared[0], rel=1e-4)
    # Too much of it damps the animation.
    assert sums[2] < 0.8 * float(truth.sum(-1).mean())
    assert solver.sparsity == MarkerSolver(small_rig, small_attachment).sparsity
