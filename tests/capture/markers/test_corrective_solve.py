"""Markers of a rig with correctives: planted weights, scipy's solvers, finite differences."""

import time
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from torch import Tensor

from planted.planted_correctives import planted_correctives
from torchface import Attachment, BlendshapeRig, load_rig, load_take
from torchface.capture import HelmetSolver, HybridSolver, MarkerSolver, WholeTakeSolver
from torchface.capture.corrective_energy import CorrectiveEnergy
from torchface.correctives import Corrective, Correctives
from torchface.errors import NameMismatchError
from torchface.geometry.rotations import rotation_matrix
from torchface.synthetic.head.performer import performer
from torchface.temporal import interpolated

SHAPES = 16


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    whole = performer(texture=False)  # of antagonists one: they are nearly each other's opposite
    linear = whole.select([name for name in whole.names if name not in ("jawRight", "mouthRight")])
    reach = linear.deltas.norm(dim=-1)
    far = reach.amax(1).argsort(descending=True)[:SHAPES].tolist()
    linear = linear.select([linear.names[i] for i in far])
    return BlendshapeRig(linear.neutral, linear.deltas, linear.names, planted_correctives(linear, 30)).double()


@pytest.fixture(scope="module")
def attachment(rig: BlendshapeRig) -> Attachment:
    moved = (rig.deltas.norm(dim=-1).amax(0) > 1).nonzero()[:, 0]
    return Attachment.from_vertices(rig.neutral, moved[:: len(moved) // 80][:80])


@pytest.fixture(scope="module")
def truth() -> Tensor:
    generator = torch.Generator().manual_seed(1)
    active = torch.rand(5, SHAPES, generator=generator) < 0.4
    return (active * torch.rand(5, SHAPES, generator=generator)).double()


@pytest.fixture(scope="module")
def markers(rig: BlendshapeRig, attachment: Attachment, truth: Tensor) -> Tensor:
    return attachment.on(rig.neutral.faces, rig(truth))


def solver_of(rig: BlendshapeRig, attachment: Attachment) -> MarkerSolver:
    return MarkerSolver(rig, attachment, sparsity=0.0, ridge=1e-9)


def test_planted_weights_come_back(rig: BlendshapeRig, attachment: Attachment, truth: Tensor, markers: Tensor) -> None:
    solver = solver_of(rig, attachment)
    assert (solver(markers) - truth).abs().max() < 1e-5
    linear = solver.without_correctives()(markers)
    assert (linear - truth).abs().mean() > 0.02
    assert solver.without_correctives().activation is None
    assert solver.activation is not None
    torch.testing.assert_close(solver.points(truth), markers)
    for one in (solver, solver.without_correctives(), solver):  # what is kept of one is not another's
        torch.testing.assert_close(one.complete_energy(markers).value(truth), one.energy(markers).value(truth))


def test_gaps_guesses_and_batches_change_nothing(
    rig: BlendshapeRig, attachment: Attachment, truth: Tensor, markers: Tensor
) -> None:
    solver = solver_of(rig, attachment)
    hidden = markers.clone()
    hidden[::2, ::7] = torch.nan
    assert (solver(hidden) - truth).abs().max() < 1e-4
    whole = solver(markers)
    one_by_one = torch.cat([solver(frame) for frame in markers.split(1)])
    assert (whole - one_by_one).abs().max() < 1e-8
    assert (whole - solver(markers, truth)).abs().max() < 1e-6
    assert solver(markers[:0]).shape == (0, SHAPES)


def test_scipy_finds_nothing_better_nearby(
    rig: BlendshapeRig, attachment: Attachment, truth: Tensor, markers: Tensor
) -> None:
    solver = MarkerSolver(rig, attachment)
    noisy = markers[:2] + 0.3 * torch.randn(2, *markers.shape[1:], generator=torch.Generator().manual_seed(2)).double()
    energy, found, start = solver.energy(noisy), solver(noisy), solver.without_correctives()(noisy)
    assert isinstance(energy, CorrectiveEnergy)
    scale = float(np.sqrt(1 / len(attachment.triangles)))

    def residuals(w: np.ndarray, frame: int) -> np.ndarray:
        points = solver.points(torch.from_numpy(w)[None])[0] - noisy[frame]
        # The penalty, linear in weights that are not negative, as a square.
        sparse = np.sqrt(solver.sparsity * w.clip(0) + 1e-18)
        return np.concatenate([scale * points.flatten().numpy(), sparse, np.sqrt(solver.ridge) * w])

    for frame in range(2):
        peer = least_squares(residuals, found[frame].numpy().clip(1e-6, 1 - 1e-6), bounds=(0, 1), args=(frame,))
        here = energy.rows(torch.tensor([frame]))
        ours = float(here.value(found[frame : frame + 1]))
        assert ours < float(here.value(torch.from_numpy(peer.x)[None])) + 1e-6
        assert np.abs(peer.x - found[frame].numpy()).max() < 1e-2
        assert ours < float(here.value(start[frame : frame + 1])) - 1e-3


def test_weights_are_differentiable_in_the_markers(rig: BlendshapeRig, attachment: Attachment, markers: Tensor) -> None:
    solver = MarkerSolver(rig, attachment)
    noise = torch.randn(2, *markers.shape[1:], generator=torch.Generator().manual_seed(3)).double()
    seen = (markers[:2] + 0.5 * noise).requires_grad_()
    direction = torch.randn(2, SHAPES, generator=torch.Generator().manual_seed(4)).double()
    (slope,) = torch.autograd.grad((solver(seen) * direction).sum(), seen)
    step = 1e-4 * noise
    with torch.no_grad():
        change = ((solver(seen + step) - solver(seen - step)) * direction).sum() / 2
    torch.testing.assert_close((slope * step).sum(), change, rtol=1e-3, atol=1e-9)


def test_the_helmets_motion_is_told_from_correctives(
    rig: BlendshapeRig, attachment: Attachment, truth: Tensor, markers: Tensor
) -> None:
    solver = HelmetSolver(rig, attachment, sparsity=0.0, ridge=1e-9)
    turned = rotation_matrix(torch.tensor([[0.03, -0.05, 0.02]], dtype=torch.float64)).expand(len(markers), -1, -1)
    pivot = solver.markers.rest.mean(0)
    slipped = (markers - pivot) @ turned.transpose(1, 2) + pivot + torch.tensor([4.0, -3.0, 2.0]).double()
    weights, motion = solver(slipped)
    assert (weights - truth).abs().max() < 2e-3
    assert (motion.undo(slipped) - markers).norm(dim=-1).max() < 2e-2


def test_predictions_pull_solves_with_correctives_too(
    rig: BlendshapeRig, attachment: Attachment, truth: Tensor, markers: Tensor
) -> None:
    solver = HybridSolver(MarkerSolver(rig, attachment))
    gamma = torch.zeros_like(truth)
    alone = solver(markers, truth, gamma)
    torch.testing.assert_close(alone, solver.markers(markers))
    gamma[:, 3] = 1e6
    predicted = torch.full_like(truth, 0.25)
    pulled = solver(markers, predicted, gamma)
    assert (pulled[:, 3] - 0.25).abs().max() < 1e-3
    energy = solver.energy(markers, predicted, gamma)
    assert (energy.value(pulled) < energy.value(alone)).all()
    # Frames that nothing joins are those of a whole take, also where a prediction pulls in some of them alone.
    predicted[:, 5], gamma[2:, 5], gamma[:, 3] = 0.9, 8.0, 2.0
    joined = WholeTakeSolver(solver.markers, smoothness=0.0, sparsity=float(solver.markers.sparsity))
    for seen in (markers, markers.clone().index_fill(1, torch.tensor([7]), torch.nan)):
        together = joined(seen, predicted=predicted, gamma=gamma)
        torch.testing.assert_close(together, solver(seen, predicted, gamma), rtol=0, atol=5e-3)


def test_a_whole_take_is_smoothed_with_correctives(rig: BlendshapeRig, attachment: Attachment) -> None:
    at = torch.linspace(0, 1, 40, dtype=torch.float64)[:, None]
    curves = (0.4 * torch.sin(5 * at + torch.arange(SHAPES)) + 0.3).clamp(min=0)
    exact = attachment.on(rig.neutral.faces, rig(curves))
    seen = exact + 0.3 * torch.randn(exact.shape, generator=torch.Generator().manual_seed(5)).double()
    seen[20:23, ::3] = torch.nan
    seen[30] = torch.nan
    solver = MarkerSolver(rig, attachment)
    whole = WholeTakeSolver(solver)
    smooth = whole(seen)
    shown = ~torch.isnan(seen).any(-1).all(1)
    alone = interpolated(solver(seen[shown]), shown.nonzero()[:, 0], len(seen))
    assert whole.energy(seen, smooth) < whole.energy(seen, alone)
    far, further = ((rig(w) - rig(curves)).norm(dim=-1).mean() for w in (smooth, alone))
    assert far < 0.72 * further
    rough = [(w[2:] - 2 * w[1:-1] + w[:-2]).square().mean() for w in (smooth, alone)]
    assert rough[0] < 0.1 * rough[1]
    # Without gaps the energy is formed another way.
    full = torch.where(torch.isnan(seen), exact, seen)
    nearly = full.clone()
    nearly[0, 0] = torch.nan
    assert (whole(full) - whole(nearly)).abs().mean() < 2e-3


def test_a_config_of_no_correctives_is_refused(rig: BlendshapeRig, attachment: Attachment) -> None:
    solver = MarkerSolver(rig, attachment)
    with pytest.raises(NameMismatchError, match=r"correctives\[0\]: found 7"):
        MarkerSolver.from_config(solver.config | {"correctives": [7]})


@pytest.mark.bench
@pytest.mark.real
def test_a_real_take_on_a_real_rig_with_correctives(ict_folder: Path, performances: list[Path]) -> None:
    rig = load_rig(ict_folder, part="face")
    jaw, smile = rig.index(["jawOpen", "mouthSmile_L"])
    definitions = (
        Corrective("open_smile", ("jawOpen", "mouthSmile_L")),
        Corrective("blink_half", ("eyeBlink_L",), 0.5),
    )
    both = (rig.deltas[jaw].norm(dim=-1) * rig.deltas[smile].norm(dim=-1)).sqrt()[:, None]
    blink = rig.deltas[rig.index(["eyeBlink_L"])[0]]
    deltas = torch.stack([0.5 * both * torch.tensor([0.6, 0.0, 0.8]), 0.3 * blink.roll(1, 1)])
    rig = BlendshapeRig(rig.neutral, rig.deltas, rig.names, Correctives(deltas, definitions))
    take = load_take(performances[0]).weights
    weights = rig.weights_from(take)
    on = rig.activation(weights) * deltas.norm(dim=-1).amax(1)
    weights = weights[on.sum(1).argsort(descending=True)[:10]]
    moved = (rig.deltas.norm(dim=-1).amax(0) > 1).nonzero()[:, 0]
    attachment = Attachment.from_vertices(rig.neutral, moved[:: len(moved) // 120][:120])
    seen = attachment.on(rig.neutral.faces, rig(weights))
    seen = seen + 0.1 * torch.randn(seen.shape, generator=torch.Generator().manual_seed(1))
    solver = MarkerSolver(rig, attachment)
    ours, linear = solver(seen), solver.without_correctives()(seen)
    far, further = (float((rig(w) - rig(weights)).norm(dim=-1).mean()) for w in (ours, linear))
    assert far < 0.85 * further


@pytest.mark.real
@pytest.mark.parametrize("levels", [2, 3])
def test_the_toy_set_of_refined_inverse_rigging_is_solved(levels: int, data: Path) -> None:
    with np.load(data / "peers" / "refined_inverse_rigging.npz") as stored:
        arrays = {name: torch.from_numpy(stored[name]) for name in stored.files}
    names = [f"shape_{i}" for i in range(60)]
    definitions, deltas = [], []
    for level in range(1, levels + 1):  # products of two, three and four shapes
        for row, drivers in enumerate(arrays[f"drivers{level}"].tolist()):
            definitions.append(Corrective(f"level{level}_{row}", tuple(names[i] for i in drivers)))
        deltas.append(arrays[f"level{level}"].unflatten(1, (-1, 3)))
    rest = arrays["neutral"].view(-1, 3)
    rig = BlendshapeRig.from_tensors(
        rest,
        torch.arange(len(rest)).view(-1, 3),
        arrays["deltas"].T.reshape(60, -1, 3),
        names,
        Correctives(torch.cat(deltas), tuple(definitions)),
    )
    weights = arrays["weights"]
    attachment = Attachment.from_vertices(rig.neutral, torch.arange(len(rest)))
    solver = MarkerSolver(rig, attachment)
    seen = rig(weights)
    solver(seen[:2])
    begin = time.process_time()
    found = solver(seen)
    spent = 1000 * (time.process_time() - begin) / len(seen)
    ours, theirs = (float((w - weights).abs().mean()) for w in (found, arrays["their_weights_levels12"]))
    active = [float((w > 1e-3).sum(1).double().mean()) for w in (found, weights)]
    print(f"\n{levels} levels: error {ours:.4f} ({theirs:.4f} theirs, of two), active {active}, {spent:.2f} ms a frame")
    assert ours < 0.1 * theirs
    assert abs(active[0] - active[1]) < 0.5
    exact = MarkerSolver(rig, attachment, sparsity=0.0, ridge=1e-9)(seen)
    assert (exact - weights).abs().max() < 1e-4
