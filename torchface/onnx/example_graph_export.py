"""Writes an ``ExampleSolver`` as an ONNX file and says how far it is from the exact solve."""

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from torchface.capture.anybody import ExampleSolver
from torchface.errors import ValueRangeError
from torchface.files.whole_files import write_file
from torchface.landmarks.images.graph_session import graph_session
from torchface.onnx.checked_export import WrittenGraph
from torchface.onnx.example_graph import example_model

_FRAMES, _FRAMES_A_POSE = 200, 10
_NOISE = 0.005  # of the eyes' distance
_HIDDEN = 0.1
# Weights of shapes that look alike settle slowly; the error of the landmarks does not feel it.
_ALLOWED = 0.02
_RATIO = 1.05


@dataclass(frozen=True)
class ExampleGap:
    """How far the graph is from the exact solve, on the frames that it was checked with."""

    frames: str
    mean: float
    worst: float
    error: tuple[float, float]  # mean distance of landmarks over the eyes', percent: the graph's and the exact solve's


@dataclass(frozen=True)
class ExampleReport(WrittenGraph):
    """What was written, and how good it is.

    Args:
        gaps: one frame after the other, all at once, and with landmarks missing.
        milliseconds, milliseconds_at_once: median of one frame by one thread of ONNX Runtime here, one after the
            other, and the least of a frame among many at once.
    """

    gaps: tuple[ExampleGap, ...]
    milliseconds: float
    milliseconds_at_once: float

    def rows(self) -> list[tuple[str, str]]:
        """The report as pairs of what and how much."""
        return [
            *super().rows(),
            ("one frame, one thread", f"{self.milliseconds:.3f} ms, {self.milliseconds_at_once:.4f} ms among many"),
            *(
                (
                    gap.frames,
                    f"weights {gap.mean:.1e} from the exact solve, at most {gap.worst:.1e}; landmarks "
                    f"{gap.error[0]:.3f} % of the eyes' distance off, exactly {gap.error[1]:.3f} %",
                )
                for gap in self.gaps
            ),
        ]


def export_example_solver(
    solver: ExampleSolver,
    path: str | Path,
    steps: int | None = None,
    landmarks: Tensor | None = None,
    facts: Mapping[str, object] | None = None,
) -> ExampleReport:
    """Writes the solve of 2D landmarks for the weights of examples as ONNX, and checks it.

    The graph takes ``landmarks`` (B,68,2), pixels, NaN where not seen, and ``previous`` (B,N), and gives ``weights``
    (B,N) and ``carried`` (B,N), the next frame's ``previous``; zeros start. The metadata holds ``shape_names``.

    Args:
        solver: of examples, by any method.
        path: the file to write; it appears only when it is complete and checked.
        steps: of splitting; 168 of a regional solver and 96 of others if absent.
        landmarks: frames to check with, (T,68,2), none missing; random sparse weights with noise if absent.
        facts: further metadata.

    Raises:
        ValueRangeError: the graph is too far from the exact solve; nothing is written.
    """
    exact = copy.deepcopy(solver).cpu()
    content = example_model(exact, steps, facts).SerializeToString()
    session = graph_session(content)
    frames = _random_frames(exact) if landmarks is None else landmarks.detach().cpu().float()
    hidden = torch.rand(frames.shape[:2], generator=torch.Generator().manual_seed(1)) < _HIDDEN
    missing = torch.where(hidden[..., None], torch.nan, frames)
    one, milliseconds = _one_by_one(session, frames, len(exact.names))
    many, at_once = _at_once(session, frames, len(exact.names))
    gaps = (
        _gap("one frame after the other", exact, frames[1:], one[1:]),
        _gap("all at once", exact, frames, many),
        _gap(
            f"{_HIDDEN:.0%} of the landmarks missing", exact, missing, _at_once(session, missing, len(exact.names))[0]
        ),
    )
    for gap in gaps:
        if not (gap.mean <= _ALLOWED and gap.error[0] <= _RATIO * gap.error[1] + 0.01):
            raise ValueRangeError(
                f"{path}: {gap.frames}, the graph's weights are {gap.mean:.2g} from the exact ones in the mean and its "
                f"landmarks {gap.error[0]:.3g} % off where {gap.error[1]:.3g} % are possible, expected {_ALLOWED} and "
                f"{_RATIO - 1:.0%} more at most: take more steps"
            )
    write_file(path, content)
    return ExampleReport(Path(path), len(content), gaps, milliseconds, at_once)


def _random_frames(solver: ExampleSolver) -> Tensor:
    """Landmarks that move from one random sparse pose to the next, with noise, in faces of other proportions."""
    generator = torch.Generator().manual_seed(0)
    poses = (_FRAMES // _FRAMES_A_POSE + 2, len(solver.names))
    keys = (torch.rand(poses, generator=generator) < 0.3) * torch.rand(poses, generator=generator)
    time_ = torch.arange(_FRAMES) / _FRAMES_A_POSE
    before, share = time_.long(), time_.frac()[:, None]
    weights = torch.lerp(keys[before], keys[before + 1], share)
    points = solver.neutral + torch.einsum("pcn,bn->bpc", solver.basis, weights)
    noise = _NOISE * solver.examples.eyes_distance * torch.randn(points.shape, generator=generator)
    return ((points + noise) * torch.tensor([1.1, 0.95]) + 20).float()


def _one_by_one(session: onnxruntime.InferenceSession, frames: Tensor, shapes: int) -> tuple[Tensor, float]:
    carried, found, times = np.zeros((1, shapes), np.float32), [], []
    for frame in frames.numpy():
        begin = time.perf_counter()
        weights, carried = session.run(None, {"landmarks": frame[None], "previous": carried})
        times.append(time.perf_counter() - begin)
        found.append(weights[0])
    return torch.from_numpy(np.stack(found)), 1000 * float(np.median(times))


def _at_once(session: onnxruntime.InferenceSession, frames: Tensor, shapes: int) -> tuple[Tensor, float]:
    inputs = {"landmarks": frames.numpy(), "previous": np.zeros((len(frames), shapes), np.float32)}
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        (weights,) = session.run(["weights"], inputs)
        times.append(time.perf_counter() - begin)
    return torch.from_numpy(np.asarray(weights)), 1000 * min(times) / len(frames)


@torch.no_grad()
def _gap(name: str, solver: ExampleSolver, frames: Tensor, weights: Tensor) -> ExampleGap:
    fit = solver.fit(frames.double())
    apart = (weights.double() - fit.weights).abs()
    eyes = fit.placement.matrix @ (solver.neutral[36] - solver.neutral[45]).double()

    def error(found: Tensor) -> float:
        distance = (solver.landmarks(type(fit)(found, fit.placement)) - frames.double()).norm(dim=-1)
        return float(100 * (distance.nanmean(1) / eyes.norm(dim=-1)).mean())

    return ExampleGap(name, float(apart.mean()), float(apart.max()), (error(weights.double()), error(fit.weights)))
