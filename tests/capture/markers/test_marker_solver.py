"""MarkerSolver gives back the weights that moved the markers."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Take, Track
from torchface.capture import MarkerSolver
from torchface.capture.energy import Quadratic
from torchface.errors import NameMismatchError, ShapeError, TopologyError, ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.optim import ProjectedGradient


def performed(rig: BlendshapeRig, attachment: Attachment, frames: int = 50) -> tuple[Tensor, Tensor]:
    """Weights in [0,1], many at a bound, and the markers they make on the rig itself."""
    generator = torch.Generator().manual_seed(2)
    weights = (2 * torch.rand(frames, len(rig.names), generator=generator, dtype=torch.float64) - 0.7).clamp(0, 1)
    return weights, attachment.on(rig.neutral.faces, rig.double()(weights))


@pytest.fixture
def setting(small_rig: BlendshapeRig, small_attachment: Attachment) -> tuple[MarkerSolver, Tensor, Tensor]:
    weights, markers = performed(small_rig, small_attachment)
    return MarkerSolver(small_rig, small_attachment, sparsity=0, ridge=0), weights, markers


def test_weights_come_back(setting: tuple[MarkerSolver, Tensor, Tensor]) -> None:
    solver, weights, markers = setting
    torch.testing.assert_close(solver(markers), weights, rtol=0, atol=1e-4)
    single = solver(markers.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), weights, rtol=0, atol=3e-3)


def test_missing_markers_do_not_matter(setting: tuple[MarkerSolver, Tensor, Tensor]) -> None:
    solver, weights, markers = setting
    missing = torch.rand(markers.shape[:2], generator=torch.Generator().manual_seed(3)) < 0.3
    markers[missing] = torch.nan
    torch.testing.assert_close(solver(markers), weights, rtol=0, atol=1e-4)
    # One coordinate that is missing takes its marker with it, whatever the others say.
    markers[7, 5] = torch.tensor([1e4, torch.nan, 1e4])
    torch.testing.assert_close(solver(markers)[7], weights[7], rtol=0, atol=1e-4)


def test_a_batch_with_gaps_is_its_frames_one_by_one(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    _, markers = performed(small_rig, small_attachment, 12)
    markers = markers + 0.5 * torch.randn(markers.shape, generator=torch.Generator().manual_seed(4))
    markers[::3, :9] = torch.nan
    solver = MarkerSolver(small_rig, small_attachment)
    whole = solver(markers)
    torch.testing.assert_close(whole, torch.cat([solver(frame[None]) for frame in markers]), rtol=0, atol=1e-8)
    energy = solver.energy(markers)
    nearby = (whole + 0.02 * torch.randn(whole.shape, generator=torch.Generator().manual_seed(5))).clamp(0, 1)
    assert (energy.value(nearby) >= energy.value(whole)).all()


def test_markers_of_a_turned_scaled_space(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    weights, markers = performed(small_rig, small_attachment)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(6)))[0]
    turn = turn * torch.linalg.det(turn).sign()
    alignment = Similarity(torch.tensor([1.3]), turn[None], torch.tensor([[10.0, -20.0, 300.0]]))
    solver = MarkerSolver(small_rig, small_attachment, alignment, sparsity=0, ridge=0)
    elsewhere = alignment.inverse().apply(markers)
    torch.testing.assert_close(solver(elsewhere), weights, rtol=0, atol=1e-3)
    # Energies count in rig space, so the same regularisation acts the same from any marker space.
    here, there = (MarkerSolver(small_rig, small_attachment, a, sparsity=0.5, ridge=0.1) for a in (None, alignment))
    torch.testing.assert_close(here(markers), there(elsewhere), rtol=0, atol=1e-3)


def test_the_residual_of_an_attachment_is_part_of_the_marker(
    small_rig: BlendshapeRig, small_attachment: Attachment
) -> None:
    weights, markers = performed(small_rig, small_attachment)
    standoff = torch.randn(40, 3, generator=torch.Generator().manual_seed(7))
    solver = MarkerSolver(small_rig, replace(small_attachment, residual=standoff), sparsity=0, ridge=0)
    torch.testing.assert_close(solver(markers + standoff), weights, rtol=0, atol=1e-4)


def test_derivatives_through_the_solve(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    _, markers = performed(small_rig, small_attachment, 3)
    markers = markers + 0.5 * torch.randn(markers.shape, generator=torch.Generator().manual_seed(8))
    hidden = torch.zeros(3, 40, dtype=torch.bool)
    hidden[1, 4] = True
    solver = MarkerSolver(small_rig, small_attachment, sparsity=0.1, ridge=0.01)
    direction = torch.randn(markers.shape, generator=torch.Generator().manual_seed(9), dtype=torch.float64)

    def along(step: Tensor) -> Tensor:
        return solver(torch.where(hidden[..., None], torch.nan, markers + step * direction))

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(along, (step,), eps=1e-5, atol=1e-6)


def test_takes_are_matched_by_label(setting: tuple[MarkerSolver, Tensor, Tensor]) -> None:
    solver, weights, markers = setting
    order = torch.randperm(40, generator=torch.Generator().manual_seed(10))[:33]
    track = Track([solver.labels[i] for i in order], markers[:, order])
    solved = solver.solve_take(Take(60.0, markers=track, timecode=tuple(str(i) for i in range(50))))
    assert solved.weights.names == solver.names
    assert solved.timecode is not None
    torch.testing.assert_close(solved.weights.values[..., 0], weights, rtol=0, atol=1e-4)


def test_bad_takes_say_what_is_wrong(setting: tuple[MarkerSolver, Tensor, Tensor]) -> None:
    solver, _, markers = setting
    with pytest.raises(NameMismatchError, match=r"'\*17'.*expected labels of the attachment: marker000"):
        solver.solve_take(Take(60.0, markers=Track(["marker003", "*17"], markers[:, :2])))
    with pytest.raises(NameMismatchError, match="no markers"):
        solver.solve_take(Take(60.0))
    markers[[4, 9]] = torch.nan
    with pytest.raises(ValueRangeError, match=r"2 of 50 frames \(4, 9\)"):
        solver(markers)
    with pytest.raises(ShapeError, match=r"expected \(B,40,3\)"):
        solver(markers[:, :39])
    markers[7, 2, 1] = torch.inf
    with pytest.raises(ValueRangeError, match=r"markers: infinite in frames \[7\]"):
        solver(markers)


def test_antagonists_are_one_quantity_whose_sign_may_change(
    small_rig: BlendshapeRig, small_attachment: Attachment
) -> None:
    """Their motions are not exactly opposite, so noise turns both on; of the two signs it is the one of less energy."""
    deltas, names = small_rig.deltas.clone(), ["jawLeft", "jawRight", *small_rig.names[2:]]
    deltas[1] = 0.3 * deltas[1] - deltas[0]
    rig = BlendshapeRig(small_rig.neutral, deltas, names)
    at = torch.linspace(-0.9, 0.9, 21).double()  # from the one side to the other during the take
    true = torch.full((21, 12), 0.4).double()
    true[:, 0], true[:, 1] = at.clamp(min=0), (-at).clamp(min=0)
    markers = small_attachment.on(rig.neutral.faces, rig.double()(true))
    markers = markers + 0.5 * torch.randn(markers.shape, generator=torch.Generator().manual_seed(1)).double()
    markers[::4, :5] = torch.nan
    solver = MarkerSolver(rig, small_attachment, antagonists=True)
    assert int((MarkerSolver(rig, small_attachment)(markers)[:, :2] > 0).all(1).sum()) > 5
    weights = solver(markers)
    assert float(weights[:, :2].amin(1).max()) == 0
    assert float((weights[:, 0] - weights[:, 1] - at).abs().max()) < 0.15
    sides = []
    for side in (0, 1):
        kept = [number for number in range(12) if number != side]
        one = BlendshapeRig(rig.neutral, rig.deltas[kept], [names[number] for number in kept])
        sides.append(
            torch.zeros_like(weights).index_copy(1, torch.tensor(kept), MarkerSolver(one, small_attachment)(markers))
        )
    energy = solver.energy(markers)
    assert isinstance(energy, Quadratic)
    better = (energy.value(sides[0]) < energy.value(sides[1]))[:, None]
    torch.testing.assert_close(weights, torch.where(better, *sides), rtol=0, atol=1e-6)
    again = MarkerSolver.from_config(solver.config)
    again.load_state_dict(solver.state_dict())
    torch.testing.assert_close(again(markers), weights, rtol=0, atol=1e-6)


def test_bad_settings_say_what_is_wrong(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    with pytest.raises(ValueRangeError, match="sparsity"):
        MarkerSolver(small_rig, small_attachment, sparsity=-1)
    with pytest.raises(ValueRangeError, match="ridge"):
        MarkerSolver(small_rig, small_attachment, ridge=float("nan"))
    with pytest.raises(TopologyError):
        MarkerSolver(small_rig, replace(small_attachment, fingerprint="another mesh"))


def test_a_program_of_ones_own_finds_the_same_weights(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    """With gaps and without, differentiable, and there again in a solver made of config and state."""
    _, markers = performed(small_rig, small_attachment, 8)
    markers[::3, :9] = torch.nan
    wanted = MarkerSolver(small_rig, small_attachment)(markers)
    solver = MarkerSolver(small_rig, small_attachment, program=ProjectedGradient(steps=3000, tolerance=1e-9))
    torch.testing.assert_close(solver(markers), wanted, rtol=0, atol=1e-6)
    markers.requires_grad_()
    slopes = [
        torch.autograd.grad(some(markers).square().sum(), markers)[0].nan_to_num(0.0)
        for some in (solver, MarkerSolver(small_rig, small_attachment))
    ]
    torch.testing.assert_close(*slopes, rtol=1e-4, atol=1e-6)
    again = MarkerSolver.from_config(solver.config)
    again.load_state_dict(solver.state_dict())
    assert again.program.steps == 3000
    with pytest.raises(ValueRangeError, match="program: found"):
        MarkerSolver(small_rig, small_attachment, program=ProjectedGradient(upper=2.0))


def test_a_shape_that_moves_no_marker_stays_at_rest_and_leaves_the_others_alone(
    small_rig: BlendshapeRig, small_attachment: Attachment
) -> None:
    weights, markers = performed(small_rig, small_attachment, 5)
    unseen = BlendshapeRig(
        small_rig.neutral, torch.cat([small_rig.deltas, torch.zeros_like(small_rig.deltas[:1])]),
        (*small_rig.names, "unseen"),
    )  # fmt: skip
    found = MarkerSolver(unseen, small_attachment, sparsity=0, ridge=0)(markers)
    torch.testing.assert_close(found[:, :-1], weights, rtol=0, atol=1e-4)
    assert not found[:, -1].any()
    layer = MarkerSolver(unseen, small_attachment, sparsity=0, ridge=0, program=ProjectedGradient())
    with pytest.raises(ValueRangeError, match=rf"found rows \[{len(weights[0])}\] of H that are zero.*add a ridge"):
        layer(markers)
