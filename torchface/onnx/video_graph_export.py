"""Writes ``VideoGraph`` as an ONNX file and says how far it is from the exact solve."""

import copy
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from torchface.capture.antagonist_shapes import one_side
from torchface.capture.own_rig import VideoSettings, VideoSolver
from torchface.capture.own_rig.landmark_offsets import LandmarkOffsets
from torchface.capture.priors import AdaptedDynamicsPrior, DynamicsPrior, ShapePrior
from torchface.errors import ShapeError, ValueRangeError
from torchface.files.whole_files import write_file
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.distortion import undistort
from torchface.geometry.rotations import rotation_matrix
from torchface.landmarks.images.graph_session import graph_session
from torchface.onnx.checked_export import WrittenGraph
from torchface.onnx.exported_model import exported_model
from torchface.onnx.unrolled_operators import TRANSLATIONS
from torchface.onnx.video_graph import LANDMARKS, VideoGraph
from torchface.rig import BlendshapeRig
from torchface.take import Track
from torchface.temporal.adaptive_kalman import LANDMARK_SETTINGS, adaptive_filter

FRAMES = 100
_MAX_FRAMES = 300  # of a video that it is checked with
_MIN_LANDMARKS = 6
_PARITY = 1e-4
_UNSEEN = 0.05  # of the landmarks it is checked with
_MAX_NOISE = 1.0  # pixels: what is left of models' errors from frame to frame, most of which stay
_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
_PERIOD, _ACTIVE = 60.0, 0.3  # frames of a gesture, proportion of shapes that take part


@dataclass(frozen=True)
class VideoReport(WrittenGraph):
    """What was written, and how good it is.

    Args:
        steps: of Gauss and Newton, a frame.
        frames: that it was checked with, each from the state that the one before handed on.
        parity: largest difference of a weight between ONNX Runtime and the same module in PyTorch, from the same state.
        gap, largest_gap: root mean square and largest difference of a weight to ``VideoSolver``, the graph leaning on
            its own states alone.
        error, exact_error: root mean square of the graph's weights, and of the exact solve's, to the true ones of a
            synthetic video; None of a video.
        milliseconds: of processor time a frame, by one thread of ONNX Runtime here.
    """

    steps: int
    frames: int
    parity: float
    gap: float
    largest_gap: float
    error: float | None
    exact_error: float | None
    milliseconds: float

    def rows(self) -> list[tuple[str, str]]:
        """The report as pairs of what and how much."""
        video = "" if self.error is not None else " of the video"
        rows = [
            *super().rows(),
            ("steps", str(self.steps)),
            ("one frame, one thread", f"{self.milliseconds:.2f} ms"),
            ("ONNX Runtime against PyTorch", f"weights at most {self.parity:.1e} apart"),
            (
                f"against the exact solve over {self.frames} frames{video}",
                f"root mean square {self.gap:.1e}, at most {self.largest_gap:.1e}",
            ),
        ]
        if self.error is not None:
            found = f"root mean square {self.error:.3f}; the exact solve {self.exact_error:.3f}"
            rows.append(("against true weights", found))
        return rows


def export_video_solver(  # noqa: PLR0913  # each is a part of the solve
    rig: BlendshapeRig,
    camera: CameraCalibration,
    path: str | Path,
    prior: ShapePrior | None = None,
    dynamics: DynamicsPrior | AdaptedDynamicsPrior | None = None,
    settings: VideoSettings | None = None,
    facts: Mapping[str, object] | None = None,
    video: Track | None = None,
    offsets: LandmarkOffsets | None = None,
) -> VideoReport:
    """Writes the video solve of one rig and camera as ONNX, and checks it.

    The graph takes ``landmarks`` (68,2), pixels, NaN where not seen, ``confidence`` (68,), and the state of the frame
    before, ``previous_`` and its name, all NaN for the first frame; it gives ``weights`` (N,), ``rotation`` (3,3),
    ``translation`` (3,), millimetres, rig to camera, and the rest of the state; see ``VideoGraph``. Pixels are of
    images without distortion. The metadata holds ``shape_names``, ``state``, ``intrinsics``, ``distortion``,
    ``width``, ``height`` (JSON), ``units``, ``version`` and ``settings``, the fields of ``VideoSettings``.

    Args:
        rig: N shapes, with its 68 landmarks annotated.
        camera: whose images the landmarks are found in.
        path: the file to write; it appears only when it is complete and checked.
        prior: which weights faces have.
        dynamics: how weights go on.
        settings: what the terms weigh; those of ``torchface track`` if absent.
        facts: further metadata, such as licence and data.
        video: landmarks that ``torchface track`` found in a video of this camera, pixels; the check runs on them,
            without the lens' distortion and filtered as ``track`` does. A synthetic video if absent.
        offsets: between the rig's landmarks and the finder's, as ``track`` estimated them with a take; none if absent.

    Raises:
        NameMismatchError: a prior was learned for other shapes than the rig has.
        ShapeError: the rig has no landmarks, or the video's are others than the 68.
        ValueRangeError: ONNX Runtime and PyTorch differ by more than 1e-4, or there is no graph for the prior; nothing
            is written.
    """
    if rig.neutral.landmarks is None:
        raise ShapeError("rig: found no landmarks, expected the 68 of iBUG's order; see torchface annotate")
    settings = settings or VideoSettings.of_found_landmarks(dynamics is not None)
    solver = VideoSolver(rig, None, camera.intrinsics, prior, dynamics, settings)
    solver = solver if offsets is None else solver.shifted(offsets)
    frames_to_check = None if video is None else check_frames(video, camera)
    return write_video_solver(solver, path, _camera_facts(camera) | dict(facts or {}), frames_to_check)


@dataclass(frozen=True, eq=False)
class CheckFrames:
    """What a graph is checked with."""

    landmarks: Tensor  # as solvers take them, (T,68,2), pixels, NaN for not seen
    confidence: Tensor  # (T,68)
    weights: Tensor | None = None  # the true ones, (T,N), where they are known


def check_frames(video: Track, camera: CameraCalibration) -> CheckFrames:
    """The first frames of a video from where a face is seen, as ``torchface track`` solves them."""
    if video.values.shape[1:] != (LANDMARKS, 2):
        raise ShapeError(f"video: found landmarks {tuple(video.values.shape)}, expected (T,{LANDMARKS},2)")
    landmarks = adaptive_filter(undistort(video.values.double(), camera), LANDMARK_SETTINGS).float()
    shown = (torch.isfinite(landmarks).all(2).sum(1) >= _MIN_LANDMARKS).nonzero()[:, 0]
    if not len(shown):
        raise ValueRangeError(f"video: found no face in {len(landmarks)} frames, expected one to check the graph with")
    kept = slice(int(shown[0]), int(shown[0]) + _MAX_FRAMES)
    confidence = torch.ones(landmarks.shape[:2]) if video.confidence is None else video.confidence.float()
    return CheckFrames(landmarks[kept], confidence[kept])


def write_video_solver(
    solver: VideoSolver,
    path: str | Path,
    facts: Mapping[str, object] | None = None,
    frames_to_check: CheckFrames | None = None,
) -> VideoReport:
    """Writes a solver with its settings as ONNX, and checks it; see :func:`export_video_solver`."""
    solver = copy.deepcopy(solver).cpu()
    graph = VideoGraph(solver).eval()
    if frames_to_check is None:
        weights, landmarks = synthetic_landmarks(solver, FRAMES)
        frames_to_check = CheckFrames(landmarks, torch.ones(landmarks.shape[:2]), weights)
    landmarks = frames_to_check.landmarks
    names = ["landmarks", "confidence", *(f"previous_{name}" for name in graph.state)]
    model = exported_model(
        graph,
        dict(zip(names, (landmarks[0], torch.ones(LANDMARKS), *graph.start()), strict=True)),
        graph.outputs,
        {
            "task": "video_solver",
            "shape_names": list(solver.names),
            "state": list(graph.state),
            "units": "pixels, millimetres; weights, 1 is the whole shape",
            "intrinsics": solver.intrinsics.tolist(),
            "landmark_weights": solver.landmark_weights.tolist(),
            "window": graph.window,
            "fps": None if solver.dynamics is None else solver.dynamics.fps,
            "settings": asdict(solver.settings),
            **(facts or {}),
        },
        translations=TRANSLATIONS,
    )
    content = model.SerializeToString()
    session = graph_session(content)
    run = _run(graph, session, names, frames_to_check)
    if not run.parity <= _PARITY:
        raise ValueRangeError(
            f"{path}: ONNX Runtime's weights differ from PyTorch's by {run.parity:.2g}, expected {_PARITY:.2g} at most"
        )
    with torch.no_grad():
        exact = solver(landmarks, confidence=frames_to_check.confidence).weights
    true = frames_to_check.weights
    apart = run.weights - exact
    write_file(path, content)
    return VideoReport(
        Path(path),
        len(content),
        solver.settings.steps,
        len(landmarks),
        run.parity,
        float(apart.square().mean().sqrt()),
        float(apart.abs().max()),
        None if true is None else float((run.weights - true).square().mean().sqrt()),
        None if true is None else float((exact - true).square().mean().sqrt()),
        run.milliseconds,
    )


@dataclass(frozen=True, eq=False)
class _Run:
    """Frames through ONNX Runtime, (T,N); how far from PyTorch; processor time a frame."""

    weights: Tensor
    parity: float
    milliseconds: float


def _run(
    graph: VideoGraph, session: onnxruntime.InferenceSession, names: list[str], frames_to_check: CheckFrames
) -> _Run:
    state = graph.start()
    weights, parity, spent = [], 0.0, 0.0
    for marks, confidence in zip(
        frames_to_check.landmarks, frames_to_check.confidence, strict=True
    ):  # each frame takes the state of the one before
        inputs = (marks, confidence, *state)
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
    return _Run(torch.stack(weights), parity, 1000 * spent / len(frames_to_check.landmarks))


def synthetic_landmarks(solver: VideoSolver, frames: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A synthetic performance of a solver's face before its camera: weights (T,N), and landmarks (T,68,2), float32.

    Some shapes come and go, the head rotates and moves; landmarks have the solver's noise, at most a pixel, and some
    are not seen.
    """
    generator = torch.Generator().manual_seed(seed)
    shapes, points = len(solver.names), solver.points
    at = torch.arange(frames, dtype=torch.float64)[:, None]
    phase = torch.rand(4, shapes, generator=generator).double()
    wave = torch.sin(2 * torch.pi * (at / (_PERIOD * (0.7 + phase[0])) + phase[1]))
    weights = one_side(wave.clamp(min=0) * phase[2] * (phase[3] < _ACTIVE), solver.signed)
    angles = torch.tensor([0.1, 0.3, 0.06]).double() * torch.sin(at / _PERIOD * torch.tensor([3.0, 4.0, 2.0]))
    rotation = torch.tensor(_UPRIGHT).double() @ rotation_matrix(angles)
    rest = points.rest[:LANDMARKS]
    tall = float(rest[:, 1].max() - rest[:, 1].min())
    K = solver.intrinsics.double()
    # The landmarks fill half the image, whose height is about twice the centre's.
    centre = torch.tensor([0.0, 0.0, float(K[1, 1]) * tall / max(float(K[1, 2]), 1.0)]).double()
    translation = centre + 0.1 * tall * torch.sin(at / 25 + torch.arange(3)) - rotation @ rest.mean(0)
    rows = points.chosen(weights, rotation, translation, K)
    placed = points.at(weights)[torch.arange(frames)[:, None], rows]
    image = (placed @ rotation.mT + translation[:, None]) @ K.T
    pixels = image[..., :2] / image[..., 2:]
    noise = solver.noise(rotation, translation).clamp(max=_MAX_NOISE)[:, None, None]
    pixels = pixels + noise * torch.randn(pixels.shape, generator=generator).double()
    unseen = torch.rand(pixels.shape[:2], generator=generator) < _UNSEEN
    return weights.float(), torch.where(unseen[..., None], torch.nan, pixels).float()


def _camera_facts(camera: CameraCalibration) -> dict[str, object]:
    return {"distortion": camera.distortion.tolist(), "width": camera.width, "height": camera.height}
