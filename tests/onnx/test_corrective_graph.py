"""The marker solve's graph of a rig with correctives: near the exact solve, and what ONNX Runtime computes."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from planted.planted_correctives import planted_correctives
from torchface import Attachment, BlendshapeRig
from torchface.capture import HybridSolver, MarkerSolver
from torchface.correctives import Corrective, Correctives
from torchface.errors import ValueRangeError
from torchface.landmarks.images.graph_session import graph_session
from torchface.onnx import SolverGraph, corrective_graph
from torchface.onnx.corrective_graph import CorrectiveGraph
from torchface.onnx.solver_graph_export import export_marker_solver, hide_markers, random_frames, solver_model
from torchface.synthetic import performer

SIDES = ("Left", "Right")
MOUTH = ["jawOpen", "jawLeft", "jawRight", "mouthClose", "mouthFunnel", "mouthPucker", "cheekPuff", "browInnerUp"]


@pytest.fixture(scope="module")
def solver() -> MarkerSolver:
    whole = performer(texture=False)
    far = whole.deltas.norm(dim=-1).amax(1).argsort(descending=True)[:10].tolist()
    rig = whole.select([whole.names[i] for i in far])
    rig = BlendshapeRig(rig.neutral, rig.deltas, rig.names, planted_correctives(rig, 20))
    moved = (rig.deltas.norm(dim=-1).amax(0) > 1).nonzero()[:, 0]
    return MarkerSolver(rig, Attachment.from_vertices(rig.neutral, moved[:: len(moved) // 40][:40]))


def test_fixed_steps_come_near_the_exact_solve(solver: MarkerSolver) -> None:
    markers = random_frames(solver, 30)
    graph, cold = CorrectiveGraph(solver), torch.zeros(30, 10)
    for shown in (markers, hide_markers(markers, 0.2)):
        energy, exact = solver.energy(shown), solver(shown)
        least = energy.value(exact.double())
        found = graph(shown, cold)
        gap = (energy.value(found.double()) - least) / least
        assert gap.median() < 1e-4
        assert gap.max() < 0.05
        linear = solver.without_correctives()(shown)
        assert ((energy.value(linear.double()) - least) / least).median() > 10 * gap.median().clamp(min=1e-6)
    nothing = torch.full_like(markers[:1], torch.nan)
    torch.testing.assert_close(graph(nothing, torch.full((1, 10), 0.25)), torch.full((1, 10), 0.25))


def test_an_infinite_marker_is_one_that_is_not_seen(solver: MarkerSolver) -> None:
    lost = random_frames(solver, 2)
    lost[1, 4] = torch.nan
    infinite, before = lost.clone(), torch.zeros(2, len(solver.names))
    infinite[1, 4, 0] = torch.inf
    graph = CorrectiveGraph(solver)
    assert torch.equal(graph(infinite, before), graph(lost, before))


@pytest.fixture(scope="module")
def alike() -> MarkerSolver:
    """Of a rig whose jawOpen, mouthFunnel and tongue move the markers nearly alike."""
    rig = performer(texture=False).select(
        [f"mouth{name}{side}" for name in ("Smile", "Frown") for side in SIDES] + MOUTH
    )
    jaw, funnel = (rig.deltas[rig.names.index(name)] for name in ("jawOpen", "mouthFunnel"))
    rig = BlendshapeRig(rig.neutral, torch.cat([rig.deltas, (jaw / 3 + funnel / 10)[None]]), (*rig.names, "tongue"))
    rig = BlendshapeRig(rig.neutral, rig.deltas, rig.names, planted_correctives(rig, 4))
    return MarkerSolver(rig, Attachment.from_vertices(rig.neutral, rig.neutral.landmarks[17:]))


def test_shapes_that_move_markers_nearly_alike_are_solved_from_cold(alike: MarkerSolver) -> None:
    weights = torch.zeros(60, len(alike.names))
    weights[:, alike.names.index("jawOpen")] = torch.linspace(0.2, 0.8, 60)
    for side in SIDES:
        weights[:, alike.names.index(f"mouthSmile{side}")] = torch.linspace(0.0, 0.9, 60)
    markers = alike.points(weights).float()
    markers += 0.3 * torch.randn(markers.shape, generator=torch.Generator().manual_seed(0))
    found = CorrectiveGraph(alike)(markers, torch.zeros_like(weights))
    torch.testing.assert_close(found, alike(markers), atol=0.01, rtol=0)


def test_the_frames_that_a_graph_is_checked_with_show_one_that_stops_too_early(
    alike: MarkerSolver, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(corrective_graph, "_RHO", 0.12)
    monkeypatch.setattr(corrective_graph, "_SPLITTING", 40)
    markers = random_frames(alike, 48, seed=1)
    found = CorrectiveGraph(alike)(markers, torch.zeros(48, len(alike.names)))
    assert (found - alike(markers)).abs().max() > 0.05


def test_a_few_of_all_shapes_of_a_face_are_solved_from_cold() -> None:
    face, generator = performer(texture=False), torch.Generator().manual_seed(0)
    rig = BlendshapeRig(face.neutral, face.deltas, face.names, planted_correctives(face, 20))
    solver = MarkerSolver(rig, Attachment.from_vertices(rig.neutral, rig.neutral.landmarks[17:]))
    weights = torch.rand(100, len(rig.names), generator=generator).square()
    weights *= torch.rand(weights.shape, generator=generator) < 0.2
    markers = solver.points(weights).float()
    markers += 0.3 * torch.randn(markers.shape, generator=generator)
    found = CorrectiveGraph(solver)(markers, torch.zeros_like(weights))
    torch.testing.assert_close(found, solver(markers), atol=0.01, rtol=0)


def test_the_other_graph_is_refused(solver: MarkerSolver) -> None:
    with pytest.raises(ValueRangeError, match="found a rig with correctives"):
        SolverGraph(solver)
    with pytest.raises(ValueRangeError, match="found a rig without correctives"):
        CorrectiveGraph(solver.without_correctives())


def predictions(frames: int) -> tuple[Tensor, Tensor]:
    """Of a third of the weights; the others' are NaN, which no one may look at."""
    generator = torch.Generator().manual_seed(3)
    predicted = torch.rand(frames, 10, generator=generator)
    gamma = 4 * torch.rand(predicted.shape, generator=generator) * (predicted > 0.66)
    return torch.where(gamma > 0, predicted, torch.nan), gamma


def test_fixed_steps_come_near_the_hybrid_solve(solver: MarkerSolver) -> None:
    markers, (predicted, gamma), cold = random_frames(solver, 30), predictions(30), torch.zeros(30, 10)
    graph, exact = CorrectiveGraph(solver), HybridSolver(solver)
    for shown in (markers, hide_markers(markers, 0.2)):
        energy, optimum = exact.energy(shown, predicted.nan_to_num(0), gamma), exact(shown, predicted, gamma)
        least = energy.value(optimum.double())
        gap = (energy.value(graph(shown, cold, predicted, gamma).double()) - least) / least
        assert gap.median() < 1e-4
        assert gap.max() < 0.05
        alone = (energy.value(solver(shown).double()) - least) / least
        assert alone.median() > 10 * gap.median().clamp(min=1e-6)
    without = CorrectiveGraph(solver)(markers, cold)
    torch.testing.assert_close(graph(markers, cold, cold + torch.nan, cold), without, rtol=0, atol=1e-5)


@pytest.mark.bench
def test_onnx_runtime_computes_products_of_up_to_eight_shapes(solver: MarkerSolver) -> None:
    """With predictions, and for frames whose gamma is 0, without."""
    rig = performer(texture=False).select(solver.names)
    names = rig.names
    definitions = tuple(Corrective(f"of_{count}", names[10 - count :]) for count in (2, 4, 8))
    definitions += (Corrective("half", names[:1], 0.5),)
    deltas = 0.5 * rig.deltas[: len(definitions)].roll(1, 2)
    rig = BlendshapeRig(rig.neutral, rig.deltas, names, Correctives(deltas, definitions))
    moved = (rig.deltas.norm(dim=-1).amax(0) > 1).nonzero()[:, 0]
    attachment = Attachment.from_vertices(rig.neutral, moved[:: len(moved) // 40][:40])
    full = MarkerSolver(rig, attachment)
    graph = CorrectiveGraph(full, steps=3)
    session = graph_session(solver_model(graph, hybrid=True).SerializeToString())
    metadata = session.get_modelmeta().custom_metadata_map
    assert (metadata["correctives"], metadata["task"]) == ("4", "hybrid_solver")
    weights = 0.5 + 0.5 * torch.rand(4, 10, generator=torch.Generator().manual_seed(1))
    shown, start, (predicted, gamma) = full.points(weights).float(), 0.5 * weights, predictions(4)
    shown[1, ::7], shown[2], gamma[3] = torch.nan, torch.nan, 0.0
    given = {"markers": shown, "previous": start, "predicted": predicted, "gamma": gamma}
    (found,) = session.run(None, {name: value.numpy() for name, value in given.items()})
    assert (torch.from_numpy(found) - graph(shown, start, predicted, gamma)).abs().max() < 1e-5
    assert (torch.from_numpy(found)[3] - graph(shown, start)[3]).abs().max() < 1e-5
    torch.testing.assert_close(torch.from_numpy(found)[2], start[2])
    exact = MarkerSolver(rig, attachment, sparsity=0.0, ridge=1e-9)(full.points(weights).float())
    assert (exact - weights).abs().max() < 1e-3


@pytest.mark.bench
def test_a_file_is_written_and_checked(solver: MarkerSolver, tmp_path: Path) -> None:
    report = export_marker_solver(solver, tmp_path / "solver.onnx")
    assert all(gap.parity < 1e-5 for gap in report.gaps)
    print(report)
