"""Writes ``VideoGraph`` as an ONNX file and says how far it is from the exact solve."""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from torchface import __version__
from torchface.capture.priors import DynamicsPrior, ShapePrior
from torchface.capture.video import VideoSolver
from torchface.errors import ShapeError, ValueRangeError
from torchface.files import write_file
from torchface.geometry.calibration import CameraCalibration
from torchface.geometry.rotations import rotation_matrix
from torchface.onnx.traced import traced_model
from torchface.onnx.video_solver import LANDMARKS, STEPS, VideoGraph
from torchface.rig import BlendshapeRig

FRAMES = 100
_PARITY = 1e-4
_UNSEEN = 0.05  # of the landmarks it is checked with
_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
_PERIOD, _ACTIVE = 60.0, 0.3  # frames of a gesture, share of shapes that take part


@dataclass(frozen=True)
class VideoReport:
    """What was written, and how good it is.

    Args:
        path: the file.
        size: in bytes.
        steps: of Gauss and Newton, a frame.
        frames: of the film that it was checked with, each frame from the state that the one before handed on.
        parity: largest difference of a weight between ONNX Runtime and the same module in PyTorch, from the same state.
        gap, largest_gap: root mean square and largest difference of a weight to ``VideoSolver``, the graph leaning on
            its own states alone.
        error, exact_error: root mean square of the graph's weights, and of the exact solve's, to the true ones.
        milliseconds: of processor time a frame, by one thread of ONNX Runtime here.
    """

    path: Path
    size: int
    steps: int
    frames: int
    parity: float
    gap: float
    largest_gap: float
    error: float
    exact_error: float
    milliseconds: float

    def rows(self) -> list[tuple[str, str]]:
        """The report as pairs of what and how much."""
        return [
            ("file", f"{self.path}, {self.size / 1000:.0f} kB"),
            ("steps", str(self.steps)),
            ("one frame, one thread", f"{self.milliseconds:.2f} ms"),
            ("ONNX Runtime against PyTorch", f"weights at most {self.parity:.1e} apart"),
            (
                f"against the exact solve over {self.frames} frames",
                f"root mean square {self.gap:.1e}, at most {self.largest_gap:.1e}",
            ),
            ("against true weights", f"root mean square {self.error:.3f}; the exact solve {self.exact_error:.3f}"),
        ]

    def __str__(self) -> str:
        return "\n".join(f"{name}: {value}" for name, value in self.rows())


def export_video_solver(
    rig: BlendshapeRig,
    camera: CameraCalibration,
    path: str | Path,
    prior: ShapePrior | None = None,
    dynamics: DynamicsPrior | None = None,
    steps: int = STEPS,
    facts: Mapping[str, object] | None = None,
) -> VideoReport:
    """Writes the video solve of one rig and camera as ONNX, and checks it.

    The graph takes ``landmarks`` (68,2), pixels, NaN where not seen, ``confidence`` (68,), and the state of the frame
    before, ``previous_`` and its name, all NaN for the first frame; it gives ``weights`` (N,), ``rotation`` (3,3),
    ``translation`` (3,), millimetres, rig to camera, and the rest of the state; see ``VideoGraph``. Pixels are of
    pictures without distortion. The metadata holds ``shape_names``, ``state``, ``intrinsics``, ``distortion``,
    ``width``, ``height`` (JSON), ``units``, ``version`` and the settings.

    Args:
        rig: N shapes, with its 68 landmarks annotated.
        camera: whose pictures the landmarks are found in.
        path: the file to write; it appears only when it is complete and checked.
        prior: which weights faces have.
        dynamics: how weights go on.
        steps: a frame.
        facts: further metadata, such as licence and data.

    Raises:
        NameMismatchError: a prior was learned for other shapes than the rig has.
        ShapeError: the rig has no landmarks.
        ValueRangeError: ONNX Runtime and PyTorch differ by more than 1e-4, or there is no graph for the prior; nothing
            is written.
    """
    if rig.neutral.landmarks is None:
        raise ShapeError("rig: found no landmarks, expected the 68 of iBUG's order; see torchface annotate")
    solver = VideoSolver(rig, None, camera.intrinsics, prior, dynamics)
    return write_video_solver(solver, path, steps, _camera_facts(camera) | dict(facts or {}))


def write_video_solver(
    solver: VideoSolver, path: str | Path, steps: int = STEPS, facts: Mapping[str, object] | None = None
) -> VideoReport:
    """Writes a solver with its settings as ONNX, and checks it; see :func:`export_video_solver`."""
    solver = copy.deepcopy(solver).cpu()
    graph = VideoGraph(solver, steps).eval()
    weights, landmarks = filmed(solver, FRAMES)
    names = ["landmarks", "confidence", *(f"previous_{name}" for name in graph.state)]
    model = traced_model(
        graph,
        dict(zip(names, (landmarks[0], torch.ones(LANDMARKS), *graph.start()), strict=True)),
        graph.outputs,
        {
            "task": "video_solver",
            "shape_names": list(solver.names),
            "state": list(graph.state),
            "units": "pixels, millimetres; weights, 1 is the whole shape",
            "version": __version__,
            "intrinsics": solver.intrinsics.tolist(),
            "steps": steps,
            "window": graph.window,
            "fps": None if solver.dynamics is None else solver.dynamics.fps,
            "pixel_noise": solver.pixel_noise,
            "sparsity": solver.sparsity,
            "ridge": solver.ridge,
            **(facts or {}),
        },
    )
    content = model.SerializeToString()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    run = _run(graph, session, names, landmarks)
    if not run.parity <= _PARITY:
        raise ValueRangeError(
            f"{path}: ONNX Runtime's weights differ from PyTorch's by {run.parity:.2g}, expected {_PARITY:.2g} at most"
        )
    with torch.no_grad():
        exact = solver(landmarks).weights
    apart = run.weights - exact
    write_file(path, content)
    return VideoReport(
        Path(path),
        len(content),
        steps,
        len(landmarks),
        run.parity,
        float(apart.square().mean().sqrt()),
        float(apart.abs().max()),
        float((run.weights - weights).square().mean().sqrt()),
        float((exact - weights).square().mean().sqrt()),
        run.milliseconds,
    )


@dataclass(frozen=True, eq=False)
class _Run:
    """A film through ONNX Runtime, (T,N); how far from PyTorch; processor time a frame."""

    weights: Tensor
    parity: float
    milliseconds: float


def _run(graph: VideoGraph, session: onnxruntime.InferenceSession, names: list[str], landmarks: Tensor) -> _Run:
    state = graph.start()
    trust = torch.ones(LANDMARKS)
    weights, parity, spent = [], 0.0, 0.0
    for marks in landmarks:  # each frame takes the state of the one before
        inputs = (marks, trust, *state)
        given = {name: value.numpy() for name, value in zip(names, inputs, strict=True)}
        begun = time.process_time()
        found = session.run(list(graph.outputs), given)
        spent += time.process_time() - begun
        outputs = dict(zip(graph.outputs, (torch.from_numpy(np.asarray(value)) for value in found), strict=True))
        with torch.no_grad():
            expected = graph(*inputs)[0]
        # A NaN is no agreement.
        gap = float((outputs["weights"] - expected).abs().max())
        parity = max(parity, gap if gap == gap else float("inf"))
        weights.append(outputs["weights"])
        state = tuple(outputs[name] for name in graph.state)
    return _Run(torch.stack(weights), parity, 1000 * spent / len(landmarks))


def filmed(solver: VideoSolver, frames: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A made-up performance of a solver's face before its camera: weights (T,N), and landmarks (T,68,2), float32.

    Some shapes come and go, the head turns and shifts; landmarks have the solver's noise, and some are not seen.
    """
    generator = torch.Generator().manual_seed(seed)
    shapes, points = len(solver.names), solver.points
    at = torch.arange(frames, dtype=torch.float64)[:, None]
    phase = torch.rand(4, shapes, generator=generator).double()
    wave = torch.sin(2 * torch.pi * (at / (_PERIOD * (0.7 + phase[0])) + phase[1]))
    weights = wave.clamp(min=0) * phase[2] * (phase[3] < _ACTIVE)
    turn = torch.tensor([0.1, 0.3, 0.06]).double() * torch.sin(at / _PERIOD * torch.tensor([3.0, 4.0, 2.0]))
    rotation = torch.tensor(_UPRIGHT).double() @ rotation_matrix(turn)
    rest = points.rest[:LANDMARKS]
    tall = float(rest[:, 1].max() - rest[:, 1].min())
    K = solver.intrinsics
    # The landmarks fill half the picture, whose height is about twice the centre's.
    centre = torch.tensor([0.0, 0.0, float(K[1, 1]) * tall / max(float(K[1, 2]), 1.0)]).double()
    translation = centre + 0.1 * tall * torch.sin(at / 25 + torch.arange(3)) - rotation @ rest.mean(0)
    rows = points.chosen(weights, rotation, translation, K)
    placed = points.at(weights)[torch.arange(frames)[:, None], rows]
    image = (placed @ rotation.mT + translation[:, None]) @ K.T
    pixels = image[..., :2] / image[..., 2:]
    pixels = pixels + solver.pixel_noise * torch.randn(pixels.shape, generator=generator).double()
    unseen = torch.rand(pixels.shape[:2], generator=generator) < _UNSEEN
    return weights.float(), torch.where(unseen[..., None], torch.nan, pixels).float()


def _camera_facts(camera: CameraCalibration) -> dict[str, object]:
    return {"distortion": camera.distortion.tolist(), "width": camera.width, "height": camera.height}
