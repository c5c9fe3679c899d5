"""What reads a clip's faces, and solvers that turn the same readings into weights of ARKit's shapes."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from planted.webcam_solver_file import webcam_solver_model
from torchface.capture.anybody import (
    AllAtOnce,
    ExampleShapes,
    ExampleSolver,
    LandmarkModel,
    Regional,
    WebcamControls,
    character_matrix,
    paper_examples,
)
from torchface.capture.anybody.examples.example_methods import ExampleMethod
from torchface.capture.own_rig import VideoState
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.landmarks.images.face_reading import READ_FOR_SOLVER, FaceReading
from torchface.landmarks.images.frame_reader.face_reader import STATE, FaceReader
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic import performer
from torchface.temporal.adaptive_kalman import LANDMARK_SETTINGS, AdaptiveFilter
from torchface.workflows.track.track_inputs import solver_for
from torchface.workflows.track.track_models import load_track_models
from torchface.workflows.webcam.webcam_graph import default_webcam_solver, webcam_networks
from train.rendered_people.webcam_performance import gaze_of

_LEAST = 6  # landmarks that a solve needs


@dataclass(frozen=True, eq=False)
class Solved:
    """What a solver makes of a clip."""

    weights: Tensor  # by ARKit's names, (T,52)
    gaze: Tensor  # (T,2,2) radians, see `gaze_of`
    milliseconds: float  # of processor time a frame, without reading the picture


Solver = Callable[[list[FaceReading], float, tuple[int, int]], Solved]
"""Solves readings of a video with so many frames a second, pixels wide and high."""


def read_faces(frames: Tensor, fps: float) -> list[FaceReading]:
    """What the shipped networks read of a face in frames uint8 (T,3,H,W), as in a webcam's model."""
    reader = FaceReader(webcam_networks()).eval()
    state, rows = torch.zeros(STATE), []
    for frame in frames:  # a frame's place is the next one's
        with torch.no_grad():
            reading, state = reader(frame.permute(1, 2, 0), torch.tensor(1 / fps), state)
        rows.append(reading)
    return rows


def _one_thread() -> onnxruntime.SessionOptions:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return options


def video_solver(readings: list[FaceReading], fps: float, size: tuple[int, int]) -> Solved:
    """``VideoSolver`` on the embedded performer's mean head, frame by frame."""
    rig = performer(texture=False)
    solver = solver_for(rig, load_track_models(rig, fps=fps), assumed_calibration(*size))
    smoother = AdaptiveFilter(68, 2, LANDMARK_SETTINGS)
    state: VideoState | None = None

    def step(reading: FaceReading) -> Tensor:
        nonlocal state
        sure = reading.trust.nan_to_num(0.0)
        landmarks = smoother.step(reading.trusted_landmarks).float()
        if state is None and int((torch.isfinite(landmarks).all(1) & (sure > 0)).sum()) < _LEAST:
            return torch.zeros(len(rig.names))
        state = solver.step(state or solver.start(), landmarks, confidence=sure, interval=1 / fps)
        return state.weights.detach().float()

    weights, milliseconds = _timed(step, readings)
    weights = weights @ mapping(rig.names, ARKIT).T
    return Solved(weights, gaze_of(weights), milliseconds)


def webcam_solver(readings: list[FaceReading], fps: float, size: tuple[int, int]) -> Solved:
    """``WebcamSolver``'s graph as ``torchface live`` and the app run it; nobody calibrates anything."""
    session = _webcam_session()
    controls = WebcamControls().tensor().numpy()
    state = np.zeros(session.get_inputs()[-1].shape, np.float32)
    fixed = {"size": np.array(size, np.float32), "interval": np.array(1 / fps, np.float32), "controls": controls}
    weights, gazes = [], []
    started = time.process_time()
    for reading in readings:  # a frame's state is the next one's
        given = {name: getattr(reading, name).numpy() for name in READ_FOR_SOLVER}
        solved, gaze, state = session.run(["weights", "gaze", "next_state"], given | fixed | {"state": state})
        weights.append(torch.from_numpy(solved))
        gazes.append(torch.from_numpy(gaze))
    milliseconds = 1000 * (time.process_time() - started) / len(readings)
    return Solved(torch.stack(weights), torch.stack(gazes), milliseconds)


@lru_cache(maxsize=1)
def _webcam_session() -> onnxruntime.InferenceSession:
    model = webcam_solver_model(default_webcam_solver()).SerializeToString()
    return onnxruntime.InferenceSession(model, _one_thread(), providers=["CPUExecutionProvider"])


def example_solver(make: Callable[[ExampleShapes], ExampleMethod]) -> Solver:
    """One of the paper's solvers with the examples that the embedded performer shows, and ARKit's names for them."""

    def solve(readings: list[FaceReading], fps: float, size: tuple[int, int]) -> Solved:
        examples = paper_examples(performer(texture=False))
        solver = ExampleSolver(examples, make(examples))
        onto = character_matrix(examples.names, ARKIT)
        before: Tensor | None = None

        def step(reading: FaceReading) -> Tensor:
            nonlocal before
            if torch.isfinite(reading.landmarks).all():
                before = solver(reading.landmarks[None], before)
            return torch.zeros(len(examples.names)) if before is None else before[0]

        weights, milliseconds = _timed(step, readings)
        weights = (weights @ onto.T).clamp(0, 1)
        return Solved(weights, gaze_of(weights), milliseconds)

    return solve


def _timed(step: Callable[[FaceReading], Tensor], readings: list[FaceReading]) -> tuple[Tensor, float]:
    """What frames give one after the other, and milliseconds of processor time a frame."""
    started = time.process_time()
    with torch.no_grad():
        rows = torch.stack([step(reading) for reading in readings])
    return rows, 1000 * (time.process_time() - started) / len(readings)


PAPER: dict[str, Solver] = {
    "paper: all at once": example_solver(lambda examples: AllAtOnce()),
    "paper: regional": example_solver(lambda examples: Regional()),
    "paper: linear model": example_solver(LandmarkModel.fit),
}
SOLVERS: dict[str, Solver] = {**PAPER, "VideoSolver, mean head": video_solver, "WebcamSolver": webcam_solver}
