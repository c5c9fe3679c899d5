"""Weights of a whole take at once: smoother where the face is slow, as high where it is fast."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Take, Track
from torchface.capture import MarkerSolver, WholeTakeSolver
from torchface.capture.markers.smooth_problem import curvature
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.optim import box_qp
from torchface.synthetic.stages.marker_stage import StageFlaws, record
from torchface.temporal.interpolation import values_at

Performance = tuple[BlendshapeRig, Attachment, list[Tensor]]


@pytest.mark.bench  # the demo's test compares both solves
def test_errors_on_the_performer_are_smaller(performance: Performance) -> None:
    rig, attachment, takes = performance
    true = takes[0][:700]
    solver = MarkerSolver(rig, attachment)
    whole = WholeTakeSolver(solver)
    for missing in (0.0, 0.3):
        flaws = StageFlaws(missing=missing)
        markers = record(rig, attachment, true, torch.Generator().manual_seed(1), flaws).take.markers
        every = 1 if missing == 0 else 10
        error = (whole(markers.values) - true).abs().mean()
        # Made-up curves have corners.
        assert error <= 0.8 * (solver(markers.values[::every]) - true[::every]).abs().mean()


@pytest.mark.parametrize("gamma", [0.0, 1.0, 30.0])
def test_without_release_it_is_the_exact_quadratic_program(
    gamma: float, small_rig: BlendshapeRig, small_attachment: Attachment
) -> None:
    generator = torch.Generator().manual_seed(0)
    frames, shapes = 14, 12
    weights = (2 * torch.rand(frames, shapes, generator=generator) - 0.7).clamp(0, 1)
    take = record(small_rig, small_attachment, weights, generator, StageFlaws(noise=1.0)).take
    solver = MarkerSolver(small_rig, small_attachment, ridge=0.01)
    whole = WholeTakeSolver(solver, smoothness=5.0, huber_threshold=float("inf"), sparsity=0.05)
    markers = take.markers.values.double()
    bend = curvature(torch.eye(frames, dtype=torch.float64))
    energy = solver.energy(markers)
    eye = torch.eye(shapes, dtype=torch.float64)
    H = torch.kron(torch.eye(frames, dtype=torch.float64), energy.H) + 10 * torch.kron(bend.T @ bend, eye)
    f = energy.f - solver.sparsity + 0.05
    # A classifier pulls some weights of some frames, which the markers' count divides.
    predicted, pull = torch.rand(2, frames, shapes, generator=generator, dtype=torch.float64)
    pull = gamma * torch.where(pull > 0.6, pull, 0.0)
    H = H + (2 * pull / len(solver.labels)).flatten().diag()
    f = f - 2 * pull / len(solver.labels) * predicted
    exact = box_qp(H, f.reshape(1, -1)).reshape(frames, shapes)
    found = whole(markers, predicted=predicted, gamma=pull) if gamma else whole(markers)
    torch.testing.assert_close(found, exact, rtol=0, atol=3e-3)
    if not gamma:
        assert whole.energy(markers, found) <= whole.energy(markers, exact) + 1e-2


def test_a_strong_prediction_of_a_frame_leaves_the_others_as_they_are(
    small_rig: BlendshapeRig, small_attachment: Attachment
) -> None:
    weights = torch.rand(6, 12, generator=torch.Generator().manual_seed(0))
    markers = small_attachment.on(small_rig.neutral.faces, small_rig(weights.double()))
    whole = WholeTakeSolver(MarkerSolver(small_rig, small_attachment), smoothness=0.0)
    gamma = torch.tensor([1e6, 0, 0, 0, 0, 0])[:, None].expand(6, 12)
    found = whole(markers, predicted=torch.full((6, 12), 0.4), gamma=gamma)
    torch.testing.assert_close(found[:1], torch.full_like(found[:1], 0.4), rtol=0, atol=1e-3)
    torch.testing.assert_close(found[1:], whole(markers)[1:], rtol=0, atol=1e-3)


def test_nothing_nearby_has_less_energy_whatever_is_hidden(
    small_rig: BlendshapeRig, small_attachment: Attachment
) -> None:
    generator = torch.Generator().manual_seed(0)
    curves = 0.5 + 0.6 * torch.sin(torch.arange(120)[:, None] / 9 + torch.arange(12))
    flaws = StageFlaws(noise=0.5, missing=0.4)
    take = record(small_rig, small_attachment, curves.clamp(0, 1), generator, flaws).take
    markers = take.markers.values.double()
    markers[50:56] = torch.nan  # frames that show nothing are bridged
    whole = WholeTakeSolver(MarkerSolver(small_rig, small_attachment))
    found = whole(markers)
    assert (found[50:56] - curves.clamp(0, 1)[50:56]).abs().mean() < 0.06
    least = whole.energy(markers, found)
    for size in (0.003, 0.03):
        for _ in range(10):
            nearby = (found + size * torch.randn(found.shape, generator=generator)).clamp(0, 1)
            assert whole.energy(markers, nearby) > least - 1e-3


@pytest.mark.parametrize("dropped", [False, True])
def test_weights_are_held_where_a_take_ends_without_markers(performance: Performance, dropped: bool) -> None:
    rig, attachment, takes = performance
    take = record(rig, attachment, takes[0][:60], torch.Generator().manual_seed(1), StageFlaws()).take
    values = take.markers.values.clone()
    values[:5], values[40:] = torch.nan, torch.nan
    seconds = torch.arange(60) / 60 + 0.5 * (torch.arange(60) > 20) if dropped else None
    found = WholeTakeSolver(MarkerSolver(rig, attachment))(values, 60.0, seconds)
    assert torch.equal(found[:5], found[5].expand(5, -1))
    assert torch.equal(found[40:], found[39].expand(20, -1))
    assert not torch.equal(found[38], found[39])


def test_a_blink_keeps_its_height(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    seconds = torch.arange(180) / 60
    blink = torch.exp(-((seconds - 1.5) ** 2) / (2 * 0.04**2))
    weights = torch.zeros(180, 12)
    weights[:, 3] = 0.9 * blink
    take = record(small_rig, small_attachment, weights, torch.Generator().manual_seed(0)).take
    solver = MarkerSolver(small_rig, small_attachment)
    kept = WholeTakeSolver(solver)(take.markers.values)[:, 3].max()
    flattened = WholeTakeSolver(solver, huber_threshold=float("inf"))(take.markers.values)[:, 3].max()
    assert kept > 0.85
    assert kept > flattened


def test_the_frame_rate_does_not_matter(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    weights = (0.5 + 0.5 * torch.sin(torch.arange(240)[:, None] / 12 + torch.arange(12))).clamp(0, 1)
    take = record(small_rig, small_attachment, weights, torch.Generator().manual_seed(0), StageFlaws(noise=0)).take
    whole = WholeTakeSolver(MarkerSolver(small_rig, small_attachment), smoothness=100.0)
    full, half = whole(take.markers.values, 60.0), whole(take.markers.values[::2], 30.0)
    torch.testing.assert_close(half[5:-5], full[::2][5:-5], rtol=0, atol=0.01)


def test_takes_by_label_in_another_space_and_bad_input(
    small_rig: BlendshapeRig, small_attachment: Attachment, stage_space: Similarity
) -> None:
    weights = torch.full((20, 12), 0.3)
    take = record(small_rig, small_attachment, weights, torch.Generator().manual_seed(0)).take
    whole = WholeTakeSolver(MarkerSolver(small_rig, small_attachment))
    order = list(reversed(take.markers.names))
    solved = whole.solve_take(Take(60.0, markers=take.markers.select(order))).weights
    here = whole(take.markers.values)
    torch.testing.assert_close(solved.values[..., 0], here, rtol=0, atol=1e-4)
    elsewhere = WholeTakeSolver(MarkerSolver(small_rig, small_attachment, stage_space.inverse()))
    torch.testing.assert_close(elsewhere(stage_space.apply(take.markers.values)), here, rtol=0, atol=5e-3)
    with pytest.raises(NameMismatchError, match="no markers"):
        whole.solve_take(Take(60.0))
    with pytest.raises(NameMismatchError, match="unknown"):
        whole.solve_take(Take(60.0, markers=Track(["unknown"], torch.zeros(2, 1, 3))))
    with pytest.raises(ShapeError, match=r"expected \(T,40,3\)"):
        whole(torch.zeros(2, 3, 3))
    with pytest.raises(ValueRangeError, match="found none in any of 2 frames"):
        whole(torch.full((2, 40, 3), torch.nan))
    with pytest.raises(ValueRangeError, match="infinite"):
        whole(torch.full((2, 40, 3), torch.inf))
    with pytest.raises(ValueRangeError, match="smoothness: found -1"):
        WholeTakeSolver(whole.markers, smoothness=-1)
    with pytest.raises(ValueRangeError, match="fps: found 0"):
        whole(take.markers.values, 0)


def test_curves_bend_in_seconds_where_frames_were_dropped(performance: Performance) -> None:
    rig, attachment, takes = performance
    true = takes[0][:240]
    markers = record(rig, attachment, true, torch.Generator().manual_seed(1)).take.markers
    keep = torch.rand(240, generator=torch.Generator().manual_seed(3)) > 0.2
    keep[100:130] = False
    keep[0] = True
    rows = keep.nonzero().flatten()
    whole = WholeTakeSolver(MarkerSolver(rig, attachment))
    gaps = markers.values.masked_fill(~keep[:, None, None], torch.nan)
    expected = whole(gaps, 60.0)[rows]
    left = Track(markers.names, markers.values[rows])
    take = Take(60.0, markers=left, seconds=5 + rows.double() / 60)
    solved = whole.solve_take(take)
    torch.testing.assert_close(solved.weights.values[..., 0], expected, atol=1e-6, rtol=0)
    assert solved.seconds.equal(take.seconds)
    shrunk = whole.solve_take(replace(take, seconds=None)).weights.values[..., 0]
    assert float((shrunk - expected).abs().max()) > 0.01  # as if nothing were missing


@pytest.mark.bench
def test_a_variable_rate_is_solved_as_well_as_an_even_one(performance: Performance) -> None:
    rig, attachment, takes = performance
    true = takes[0][:160]
    even = torch.arange(160, dtype=torch.float64) / 60
    steps = torch.rand(100, generator=torch.Generator().manual_seed(3), dtype=torch.float64).mul(2).add(0.5)
    seconds = steps.cumsum(0) / 60
    seconds = seconds[seconds < even[-1]]
    there = values_at(true, even, seconds)
    as_many = values_at(true, even, torch.arange(len(seconds), dtype=torch.float64) / 40)
    record_of = lambda weights: record(rig, attachment, weights, torch.Generator().manual_seed(1)).take.markers  # noqa: E731
    whole = WholeTakeSolver(MarkerSolver(rig, attachment))
    felt = [not name.startswith("eyeLook") for name in rig.names]  # lids hardly say where eyes look
    base = (whole(record_of(as_many).values, 40.0) - as_many)[:, felt].abs().mean()
    solved = whole(record_of(there).values, 60.0, seconds)
    assert (solved - there)[:, felt].abs().mean() < 1.3 * base
