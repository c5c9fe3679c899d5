"""Files of the marker and the hybrid solve: what ONNX Runtime computes is the module, and near the exact solve."""

import json
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, __version__
from torchface.capture import HybridSolver, MarkerSolver
from torchface.errors import ValueRangeError
from torchface.onnx import GraphSteps, SolverReport, export_model, export_solver, solver_graph_export
from torchface.onnx.solver_graph_export import SolverGap, hide_markers, random_frames, solver_graph
from torchface.synthetic.stages import place_markers

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "solve_onnx.py"
# Importing torch would defeat the example's point, so it is made impossible.
WITHOUT_TORCH = "import sys, runpy; sys.modules['torch'] = None; sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0])"


@cache
def opened(path: Path) -> onnxruntime.InferenceSession:
    """A file's session, which takes longer than all frames do."""
    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])


def run(path: Path, *inputs: Tensor) -> Tensor:
    session = opened(path)
    names = (entry.name for entry in session.get_inputs())
    (weights,) = session.run(["weights"], {name: value.numpy() for name, value in zip(names, inputs, strict=True)})
    return torch.from_numpy(weights)


@pytest.fixture(scope="module")
def written(turned_bumps: MarkerSolver, tmp_path_factory: pytest.TempPathFactory) -> SolverReport:
    report = export_model(turned_bumps, tmp_path_factory.mktemp("graph") / "solver.onnx", {"data": "planted"})
    assert isinstance(report, SolverReport)
    return report


@pytest.mark.parametrize(("apart", "usual"), [(1.9e-6, True), (2e-5, False)])
def test_words_say_what_rounding_makes_and_how_much_more_is_usual(apart: float, usual: bool) -> None:
    words = SolverGap(0.0, 0.0, 0.0, 0.0, parity=apart, rounding=1.1e-6).runtime()
    assert f"{apart:.1e}; rounding alone makes 1.1e-06" in words
    assert words.endswith(", up to 10 times as much is usual") == usual


def test_the_file_is_the_graph(written: SolverReport, turned_bumps: MarkerSolver) -> None:
    path = written.path
    assert [gap.missing for gap in written.gaps] == [0.0, 0.1, 0.3]
    assert max(gap.parity for gap in written.gaps) <= 1e-5
    assert max(gap.worst for gap in written.gaps) <= 1e-5
    assert written.verdict().startswith("result: good, the graph's error")
    assert "at most 0.00" in written.verdict()
    few = replace(written, gaps=(replace(written.gaps[0], worst=2e-3), *written.gaps[1:]))
    assert few.verdict().startswith("result: poor, the graph's error")
    assert "at most 0.2 % above" in few.verdict()
    assert written.size == path.stat().st_size
    assert "30% of the markers missing" in str(written)
    assert list(path.parent.iterdir()) == [path]

    graph = solver_graph(turned_bumps)
    assert graph.rho == written.rho
    markers = random_frames(turned_bumps, 20, seed=5)
    markers[3, 7] = torch.nan
    previous = torch.rand(20, 10, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(run(path, markers, previous), graph(markers, previous), rtol=0, atol=1e-5)
    # One by one the frames without gaps go through the other branch, to the same weights.
    alone = torch.cat([run(path, markers[i : i + 1], previous[i : i + 1]) for i in range(20)])
    energy = turned_bumps.energy(markers.double())
    least = energy.value(turned_bumps(markers.double()))
    assert ((energy.value(alone.double()) - least) / least).max() <= 1e-5


def test_an_infinite_marker_is_one_that_is_not_seen(written: SolverReport, turned_bumps: MarkerSolver) -> None:
    lost = random_frames(turned_bumps, 3)
    lost[1, 4] = torch.nan
    infinite, before = lost.clone(), torch.zeros(3, 10)
    infinite[1, 4] = torch.tensor([5.0, -torch.inf, 5.0])
    graph = solver_graph(turned_bumps)
    assert torch.equal(graph(infinite, before), graph(lost, before))
    assert torch.equal(run(written.path, infinite, before), run(written.path, lost, before))


def test_the_metadata_says_what_goes_in_and_out(written: SolverReport, turned_bumps: MarkerSolver) -> None:
    loaded = opened(written.path)
    assert {i.name: i.shape for i in loaded.get_inputs()} == {"markers": ["batch", 36, 3], "previous": ["batch", 10]}
    assert {o.name: o.shape for o in loaded.get_outputs()} == {"weights": ["batch", 10]}
    metadata = loaded.get_modelmeta().custom_metadata_map
    assert tuple(json.loads(metadata["shape_names"])) == turned_bumps.names
    assert tuple(json.loads(metadata["marker_labels"])) == turned_bumps.labels
    assert metadata["units"] == "millimetres"
    assert (metadata["version"], metadata["data"]) == (__version__, "planted")
    assert json.loads(metadata["steps"]) == [66, 96]
    assert {opset.domain for opset in onnx.load(written.path).opset_import} == {""}


def test_the_example_solves_with_onnxruntime_and_numpy_alone(
    written: SolverReport, turned_bumps: MarkerSolver, tmp_path: Path
) -> None:
    markers = random_frames(turned_bumps, 30)
    markers[4, 2] = torch.nan
    np.save(tmp_path / "markers.npy", markers.numpy())
    given = [EXAMPLE, written.path, tmp_path / "markers.npy", tmp_path / "weights.npy"]
    command = [sys.executable, "-c", WITHOUT_TORCH, *map(str, given)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "30 frames" in done.stdout
    solved = torch.from_numpy(np.load(tmp_path / "weights.npy"))
    torch.testing.assert_close(solved, turned_bumps(markers), rtol=0, atol=5e-3)
    command[-1] = str(tmp_path / "weights.csv")  # which it would write as weights.csv.npy
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, "weights.npy" in done.stderr) == (1, True)


def test_a_graph_that_disagrees_is_not_written(
    written: SolverReport,
    bump_rig: BlendshapeRig,
    bump_sites: Attachment,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The file of another alignment is no solver of this one."""
    monkeypatch.setattr(solver_graph_export, "exported_model", lambda *_, **__: onnx.load(written.path))
    with pytest.raises(ValueRangeError, match="ONNX Runtime differs from PyTorch"):
        export_solver(bump_rig, bump_sites, tmp_path / "solver.onnx")
    assert not list(tmp_path.iterdir())


def test_shapes_that_are_sums_of_others_are_named(
    bump_rig: BlendshapeRig,
    bump_sites: Attachment,
    written: SolverReport,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By the report, for which the graph is run as it is: its export takes ten seconds and is tried above."""
    ran: list[torch.nn.Module] = []

    def session(_: bytes) -> SimpleNamespace:
        def run(_: None, given: dict[str, np.ndarray]) -> list[np.ndarray]:
            return [ran[0](*map(torch.from_numpy, given.values())).numpy()]

        inputs = [SimpleNamespace(name=name, shape=["batch", 11]) for name in ("markers", "previous")]
        return SimpleNamespace(get_inputs=lambda: inputs, run=run)

    monkeypatch.setattr(solver_graph_export, "solver_model", lambda graph, *_: ran.append(graph) or onnx.ModelProto())
    monkeypatch.setattr(solver_graph_export, "graph_session", session)
    monkeypatch.setattr(solver_graph_export, "_TEST_FRAMES", 64)
    assert (written.mixed, max(gap.distance for gap in written.gaps) < 0.01) == ((), True)
    deltas = torch.cat([bump_rig.deltas, bump_rig.deltas[:2].sum(0, keepdim=True)])
    names = (*bump_rig.names, "both")
    report = export_solver(BlendshapeRig(bump_rig.neutral, deltas, names), bump_sites, tmp_path / "solver.onnx")
    assert report.mixed == (*bump_rig.names[:2], "both")
    assert "weights at most" in str(report)
    far = replace(report, gaps=(replace(report.gaps[0], worst=2e-4, distance=0.47),))
    assert far.verdict().startswith("result: poor")
    assert (
        f"0.47 from the exact solve's, as the markers do not distinguish {names[0]}, {names[1]}, both" in far.verdict()
    )


@pytest.mark.bench  # torch.export takes twenty seconds; test_solver_graph.py tries the module that is exported
def test_the_hybrid_file_computes_it_and_says_what_it_takes(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    path = tmp_path / "hybrid.onnx"
    report = export_solver(dome_rig, place_markers(dome_rig, 30), path, hybrid=True)
    assert max(gap.parity for gap in report.gaps) <= 1e-5
    assert max(gap.worst for gap in report.gaps) <= 1e-4
    solver = MarkerSolver(dome_rig, place_markers(dome_rig, 30))
    markers, generator = random_frames(solver, 8), torch.Generator().manual_seed(3)
    predicted = torch.rand(8, len(solver.names), generator=generator)
    gamma = 4 * torch.rand(predicted.shape, generator=generator) * (predicted > 0.5)
    predicted = torch.where(gamma > 0, predicted, torch.nan)
    for shown in (markers, hide_markers(markers, 0.2)):
        weights = run(path, shown, torch.zeros_like(gamma), predicted, gamma)
        exact = HybridSolver(solver)(shown.double(), predicted.double(), gamma.double())
        torch.testing.assert_close(weights.double(), exact, rtol=0, atol=2e-3)
    metadata = {entry.key: entry.value for entry in onnx.load(path).metadata_props}
    assert metadata["task"] == "hybrid_solver"
    assert json.loads(metadata["shape_names"]) == list(dome_rig.names)


def test_steps_are_counted() -> None:
    with pytest.raises(ValueRangeError, match="steps with gaps"):
        GraphSteps(with_gaps=0)


@pytest.mark.bench  # torch.export takes twenty seconds
@pytest.mark.real
@pytest.mark.parametrize(("markers", "worst"), [(100, 1e-5), (50, 5e-5)])
def test_small_and_close_to_the_exact_solve(
    real_capture: tuple[BlendshapeRig, Attachment, list[Tensor]], tmp_path: Path, markers: int, worst: float
) -> None:
    rig, attachment, takes = real_capture
    layout = attachment.select((attachment.labels or ())[:markers])
    points = layout.on(rig.neutral.faces, rig(torch.cat(takes)[::40]))
    points = points + 0.3 * torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    report = export_solver(rig, layout, tmp_path / "solver.onnx", markers=points)
    assert report.size <= 200_000
    assert report.gaps[0].worst <= worst
    # The gaps with missing markers are reported, not promised; that they stay small is what the graph is built for.
    assert max(gap.worst for gap in report.gaps) <= 1e-4
    assert max(gap.parity for gap in report.gaps) <= 1e-5
