"""Files of ``SolverGraph`` and ``CorrectiveGraph``, and how far they are from the exact solve."""

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture.markers.hybrid_solver import GAMMA, HybridSolver
from torchface.capture.markers.marker_solver import MarkerSolver, penalty_value
from torchface.capture.markers.observability import observability
from torchface.errors import ValueRangeError
from torchface.escaped_text import listed
from torchface.files.whole_files import write_file
from torchface.landmarks.images.graph_session import graph_session
from torchface.number_checks import checked_count
from torchface.onnx.checked_export import WrittenGraph
from torchface.onnx.corrective_graph import CorrectiveGraph
from torchface.onnx.exported_model import exported_model
from torchface.onnx.solver_graph import STEPS_WITH_GAPS, SolverGraph
from torchface.optim.fixed_splitting import STEPS, FixedSplitting
from torchface.optim.projected_gradient import ProjectedGradient
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig

_RHOS = (0.03, 0.045, 0.06, 0.075, 0.09, 0.12, 0.16, 0.22, 0.3, 0.4)
GRADIENT_STEPS, GRADIENT_STEPS_WITH_GAPS = 300, 500
_PARITY = 1e-5
_USUAL = 1e-3  # of the energy: 0.0003 mm of a marker error of 0.5 mm
# Two runs that round differently may lie a few times as far from each other as one does from the exact sum; a graph
# that computes something else lies much farther.
_ROUNDINGS = 10.0
_FAR = 0.05  # of a weight from the exact solve's: seen in an animation
_TEST_FRAMES, _CORRECTIVE_FRAMES = 512, 48
_FRAMES_A_POSE, _ACTIVE = 10, (0.2, 0.7)  # shares of the shapes that every other pose has
_MISSING = (0.0, 0.1, 0.3)


@dataclass(frozen=True)
class SolverGap:
    """How far the graph is from the exact solve, as (E(w) - E*) / E* with E in mm² a marker."""

    missing: float  # share of markers missing
    worst: float
    median: float
    distance: float  # largest of a weight from the exact solve's
    parity: float  # largest difference of a weight between ONNX Runtime and the same graph in PyTorch
    # The same between PyTorch in single and in double precision: what shapes that the markers hardly see owe to
    # rounding alone.
    rounding: float

    def runtime(self) -> str:
        """How far ONNX Runtime is from PyTorch, in words."""
        usual = f", up to {_ROUNDINGS:.0f} times as much is usual" if self.parity <= _ROUNDINGS * self.rounding else ""
        return (
            f"ONNX Runtime's weights differ from PyTorch's by {self.parity:.1e}; "
            f"rounding alone makes {self.rounding:.1e}{usual}"
        )


@dataclass(frozen=True)
class SolverReport(WrittenGraph):
    """What was written, and how good it is.

    Args:
        rho: of splitting, chosen for this rig and layout.
        steps, steps_with_gaps: how many.
        gaps: at 0, 10 and 30 % missing markers.
        milliseconds: median of one frame by one thread of ONNX Runtime here, every marker seen.
        milliseconds_with_gaps: the same with missing markers.
        mixed: shapes whose motion of the markers others imitate.
    """

    rho: float | None
    steps: int
    steps_with_gaps: int
    gaps: tuple[SolverGap, ...]
    milliseconds: float
    milliseconds_with_gaps: float
    mixed: tuple[str, ...] = ()  # shapes that the markers cannot distinguish from others

    def verdict(self) -> str:
        """Whether the graph is to be used, in a line; what ONNX Runtime computes otherwise than PyTorch is an error."""
        worst = max((gap.worst for gap in self.gaps), default=0.0)
        found = (
            f"the graph's error (squared distances and penalties) is at most {max(100 * worst, 0.001):.2g} % above the "
            f"exact solve's (usual: below {100 * _USUAL:.2g} %)"
        )
        far = max((gap.distance for gap in self.gaps), default=0.0)
        if far > _FAR:
            found += f"; weights lie up to {far:.2f} from the exact solve's"
        if far > _FAR and self.mixed:
            mixed = listed(self.mixed)
            found += f", as the markers do not distinguish {mixed} from one another: leave out what others add up to"
        if worst > _USUAL or far > _FAR:
            return f"result: poor, {found}; more steps bring it nearer (GraphSteps in Python), or the other --method"
        return f"result: good, {found}, and ONNX Runtime gives the weights that PyTorch gives"

    def rows(self) -> list[tuple[str, str]]:
        """The report as pairs of what and how much."""
        rho = "" if self.rho is None else f"; rho {self.rho}"
        rows = [
            *super().rows(),
            ("steps", f"{self.steps}, {self.steps_with_gaps} with missing markers{rho}"),
            ("one frame, one thread", f"{self.milliseconds:.3f} ms, {self.milliseconds_with_gaps:.3f} ms with gaps"),
        ]
        for gap in self.gaps:
            rows.append(
                (
                    f"{gap.missing:.0%} of the markers missing",
                    f"the graph's error is at most {100 * gap.worst:.1e} % above the exact solve's, in the median "
                    f"{100 * gap.median:.1e} %; weights at most {gap.distance:.2g} apart; {gap.runtime()}",
                )
            )
        return rows


@dataclass(frozen=True)
class GraphSteps:
    """The steps that a solver's graph takes; see ``SolverGraph``.

    Args:
        seen: for batches in which every marker is seen; 66, or 300 of projected gradient, if absent.
        with_gaps: for batches with missing markers; 96, or 500 of projected gradient, if absent.
        method: operator splitting, written out, or ``ProjectedGradient``, a ``Loop``.

    Raises:
        ValueRangeError: less than one.

    Example:
        >>> GraphSteps(seen=20).seen
        20
    """

    seen: int | None = None
    with_gaps: int | None = None
    method: Literal["splitting", "projected-gradient"] = "splitting"

    def __post_init__(self) -> None:
        for name, value in (("steps", self.seen), ("steps with gaps", self.with_gaps)):
            if value is not None:
                checked_count(name, value, 1)


def export_solver(
    rig: BlendshapeRig,
    attachment: Attachment,
    path: str | Path,
    steps: GraphSteps = GraphSteps(),
    markers: Tensor | None = None,
    hybrid: bool = False,
) -> SolverReport:
    """Writes the marker solve of one rig and layout as ONNX, and checks it.

    The graph takes ``markers`` (B,M,3), millimetres, NaN where not seen, and ``previous`` (B,N), and gives ``weights``
    (B,N). That of the hybrid solve takes two inputs more: ``predicted`` (B,N), the weights that a classifier says, and
    ``gamma`` (B,N), how much that counts, mm² over all markers; where gamma is zero in a whole batch it computes what
    the other graph does. The metadata holds ``shape_names`` and ``marker_labels`` (JSON), ``units``, ``version`` and
    the settings.

    Args:
        rig: N shapes.
        attachment: M markers.
        path: the file to write; it appears only when it is complete and checked.
        steps: of the graph's solve; a rig with correctives takes ``CorrectiveGraph``'s.
        markers: frames to check with, (T,M,3), without gaps; random weights and 0.3 mm of noise if absent.
        hybrid: the hybrid solve, checked with random predictions for a seventh of the weights. ``export_model`` writes
            a ``MarkerSolver`` with an alignment or other penalties.

    Raises:
        ValueRangeError: ONNX Runtime and PyTorch differ by more than 1e-5 and more than rounding explains; nothing is
            written.
    """
    return export_marker_solver(MarkerSolver(rig, attachment), path, steps, markers, hybrid=hybrid)


def export_marker_solver(
    solver: MarkerSolver,
    path: str | Path,
    steps: GraphSteps = GraphSteps(),
    markers: Tensor | None = None,
    facts: Mapping[str, object] | None = None,
    hybrid: bool = False,
    progress: Progress | None = None,
) -> SolverReport:
    """Writes a solver as ONNX, with the inputs of the ``hybrid`` solve if asked, and checks it; see
    :func:`export_solver`."""
    progress = progress or silent
    solver = copy.deepcopy(solver).cpu().float()
    frames = _frames(solver, markers)
    progress("choosing the graph's settings")
    graph = solver_graph(solver, markers, steps)
    if not hybrid:
        return _export(graph, solver, frames, (), path, facts, progress)
    generator = torch.Generator().manual_seed(1)
    shape = (len(frames), len(solver.names))
    predicted, strength = torch.rand(shape, generator=generator), GAMMA * torch.rand(shape, generator=generator)
    gamma = torch.where(torch.rand(shape, generator=generator) < 1 / 7, strength, 0.0)
    return _export(graph, HybridSolver(solver), frames, (predicted, gamma), path, facts, progress)


def solver_graph(
    solver: MarkerSolver, markers: Tensor | None = None, steps: GraphSteps = GraphSteps()
) -> SolverGraph | CorrectiveGraph:
    """The graph of a solver, on the CPU, its rho chosen for markers (T,M,3) without gaps; of poses of few shapes if
    absent, whose rho suits real takes of a hundred markers, while of fifty that of many shapes is as good."""
    if solver.activation is not None:
        if steps.method != "splitting":
            raise ValueRangeError(f"method: found {steps.method} for a rig with correctives, expected splitting")
        return CorrectiveGraph(solver)
    H = solver.complete_hessian()
    if steps.method == "projected-gradient":
        seen, gaps = steps.seen or GRADIENT_STEPS, steps.with_gaps or GRADIENT_STEPS_WITH_GAPS
        return SolverGraph(solver, ProjectedGradient(H, steps=seen), ProjectedGradient(steps=gaps))
    seen, gaps = steps.seen or STEPS, steps.with_gaps or STEPS_WITH_GAPS
    frames = random_frames(solver, _TEST_FRAMES, shares=_ACTIVE[:1]) if markers is None else markers.cpu().float()
    rho = choose_rho(solver, seen, frames)
    return SolverGraph(solver, FixedSplitting(H, steps=seen, rho=rho), FixedSplitting(steps=gaps, rho=rho))


def solver_model(
    graph: SolverGraph | CorrectiveGraph, hybrid: bool = False, facts: Mapping[str, object] | None = None
) -> onnx.ModelProto:
    """A graph as ONNX, with the inputs of the hybrid solve or without."""
    solver = graph.solver
    names = ("markers", "previous", "predicted", "gamma") if hybrid else ("markers", "previous")
    markers, weights = solver.rest.expand(2, -1, -1), torch.zeros(3, 2, len(solver.names))
    correctives = {} if solver.activation is None else {"correctives": len(solver.activation.definitions)}
    return exported_model(
        graph,
        dict(zip(names, (value.clone() for value in (markers, *weights)), strict=False)),  # each in its own memory
        ["weights"],
        {
            "task": "hybrid_solver" if hybrid else "solver",
            "shape_names": list(solver.names),
            "marker_labels": list(solver.labels),
            **correctives,
            "units": "millimetres",
            "sparsity": penalty_value(solver.sparsity),
            "ridge": penalty_value(solver.ridge),
            "steps": list(graph.steps),
            **(facts or {}),
        },
        dict.fromkeys(names, ("batch",)),
    )


def _frames(solver: MarkerSolver, markers: Tensor | None) -> Tensor:
    """What a graph is checked with, (T,M,3)."""
    count = _TEST_FRAMES if solver.activation is None else _CORRECTIVE_FRAMES
    return random_frames(solver, count) if markers is None else markers.cpu().float()


def _export(
    graph: SolverGraph | CorrectiveGraph,
    solver: MarkerSolver | HybridSolver,
    frames: Tensor,
    more: tuple[Tensor, ...],
    path: str | Path,
    facts: Mapping[str, object] | None,
    progress: Progress,
) -> SolverReport:
    """Checks and writes a graph; ``more`` are its inputs after the markers and the weights before."""
    progress("writing the graph, half a minute")
    content = solver_model(graph, bool(more), facts).SerializeToString()
    session, gaps = graph_session(content), []
    for count, missing in enumerate(_MISSING):
        progress("comparing the graph with the exact solve", count, len(_MISSING))
        gap = _gap(session, graph, solver, frames, more, missing)
        gaps.append(gap)
        allowed = max(_PARITY, _ROUNDINGS * gap.rounding)
        if not gap.parity <= allowed:
            raise ValueRangeError(
                f"{path}: ONNX Runtime differs from PyTorch by {gap.parity:.2g}, expected {allowed:.2g} at most"
            )
    write_file(path, content)
    progress("timing the graph")
    return SolverReport(
        Path(path),
        len(content),
        graph.rho,
        *graph.steps,
        tuple(gaps),
        _milliseconds(session, frames, more),
        _milliseconds(session, hide_markers(frames, 0.3), more),
        observability(graph.solver).ambiguous,
    )


def choose_rho(solver: MarkerSolver, steps: int, markers: Tensor) -> float:
    """The metric's rho of a small set that leaves the least gap on these markers (T,M,3), from cold.

    A small rho suits the few frames with a slow mode, a larger one all others: the 98 % quantile weighs the two.
    """
    energy, H, f = solver.energy(markers), solver.complete_hessian(), solver.complete_slope(markers)
    least = energy.value(solver(markers.double()))

    def gap(rho: float) -> float:
        found = FixedSplitting(H, steps=steps, rho=rho)(f).double()
        return float((energy.value(found) / least).quantile(0.98))

    return min(_RHOS, key=gap)


def random_frames(
    solver: MarkerSolver, count: int, noise: float = 0.3, seed: int = 0, shares: tuple[float, ...] = _ACTIVE
) -> Tensor:
    """Markers (T,M,3) that move from one random pose to the next, with noise in millimetres, in marker space; poses
    have these shares of the shapes in turn, few and many if absent."""
    generator = torch.Generator().manual_seed(seed)
    poses = (count // _FRAMES_A_POSE + 2, len(solver.names))
    active = torch.rand(poses, generator=generator) < torch.tensor(shares)[torch.arange(poses[0]) % len(shares), None]
    keys = active * torch.rand(poses, generator=generator).square()
    time_ = torch.arange(count) / _FRAMES_A_POSE
    before, share = time_.long(), time_.frac()[:, None]
    weights = (torch.lerp(keys[before], keys[before + 1], share)).to(solver.basis)
    points = solver.points(weights).to(solver.rest)
    points = points + noise * torch.randn(points.shape, generator=generator)
    return points if solver.alignment is None else solver.alignment.inverse().apply(points)


def hide_markers(markers: Tensor, share: float, seed: int = 0) -> Tensor:
    """The markers with this share of them NaN, at least one seen a frame."""
    order = torch.rand(markers.shape[:2], generator=torch.Generator().manual_seed(seed)).argsort(-1)
    hidden = order < min(round(share * markers.shape[1]), markers.shape[1] - 1)
    return torch.where(hidden[..., None], torch.nan, markers)


def _run(session: onnxruntime.InferenceSession, markers: Tensor, previous: Tensor, more: tuple[Tensor, ...]) -> Tensor:
    names = (entry.name for entry in session.get_inputs())
    inputs = zip(names, (markers, previous, *more), strict=True)
    (weights,) = session.run(None, {name: value.numpy() for name, value in inputs})
    return torch.from_numpy(np.asarray(weights))


def _gap(
    session: onnxruntime.InferenceSession,
    graph: SolverGraph | CorrectiveGraph,
    solver: MarkerSolver | HybridSolver,
    frames: Tensor,
    more: tuple[Tensor, ...],
    missing: float,
) -> SolverGap:
    """Cold and, from the weights of the frame before, warm: the worse of the two."""
    markers = hide_markers(frames, missing)
    exact = copy.deepcopy(solver).double()
    precise_more = tuple(value.double() for value in more)
    energy = exact.energy(markers.double(), *precise_more)
    optimum = exact(markers.double(), *precise_more)
    least = energy.value(optimum)
    starts = (torch.zeros_like(optimum).float(), optimum.roll(1, 0).float())
    solved = [_run(session, markers, start, more) for start in starts]
    here = [graph(markers, start, *more) for start in starts]
    parity = max(float((own - weights).abs().max()) for own, weights in zip(here, solved, strict=True))
    double = copy.deepcopy(graph).double()
    precise = [double(markers.double(), start.double(), *precise_more) for start in starts]
    rounding = max(float((own - weights).abs().max()) for own, weights in zip(here, precise, strict=True))
    gaps = torch.stack([(energy.value(weights.double()) - least) / least for weights in solved])
    distance = max(float((weights.double() - optimum).abs().max()) for weights in solved)
    return SolverGap(missing, float(gaps.max()), float(gaps.median()), distance, parity, rounding)


def _milliseconds(session: onnxruntime.InferenceSession, frames: Tensor, more: tuple[Tensor, ...]) -> float:
    previous = torch.zeros(1, session.get_inputs()[1].shape[1])
    times = []
    for frame, *others in zip(frames.split(1), *(value.split(1) for value in more), strict=True):
        begin = time.perf_counter()
        previous = _run(session, frame, previous, tuple(others))
        times.append(time.perf_counter() - begin)
    return 1000 * float(np.median(times))
