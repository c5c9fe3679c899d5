"""What reads a clip's faces, and solvers that turn the same readings into weights of ARKit's shapes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from safetensors.torch import load_file, save
from torch import Tensor

from torchface.capture.video import VideoState
from torchface.capture.video.landmark_smoothing import LandmarkFilter
from torchface.files.content_keys import content_key
from torchface.files.whole_files import write_file
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.landmarks import LandmarkTracker, TrackedFace
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.landmark_finder import trust_of
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic import performer
from torchface.synthetic.stages.webcam.webcam_performance import gaze_of
from torchface.workflows.named_finders import load_finder
from torchface.workflows.track.track_models import load_track_models
from torchface.workflows.track.track_video import solver_for

SIZE = (640, 480)
_HALF = 0.02  # of a box's side: the deviation at which a confidence is one half
_SHUT, _SHUT_WIDTH = 0.1, 0.03  # openness of eyes that may well be shut
_LEAST = 6  # landmarks that a solve needs


@dataclass(frozen=True, eq=False)
class Solved:
    """What a solver makes of a clip.

    Args:
        weights: by ARKit's names, (T,52).
        gaze: (T,2,2) radians, see ``gaze_of``.
        milliseconds: of processor time a frame, without reading the picture.
    """

    weights: Tensor
    gaze: Tensor
    milliseconds: float


Solver = Callable[[list[FaceReading], Tensor, float], Solved]
"""Solves readings and how far each landmark is to be trusted (T,68) at frames a second."""


def read_faces(frames: Tensor, kept: Path) -> tuple[list[FaceReading], Tensor]:
    """What the shipped networks read of the largest face in frames uint8 (T,3,H,W), and their trust (T,68); kept."""
    named = load_finder()
    path = kept / f"{content_key('faces read/1', finder=Path(named.source), frames=frames)[:16]}.safetensors"
    if not path.is_file():
        tracker = LandmarkTracker(named.finder)
        rows = [_reading(tracker.step(frame)) for frame in frames]
        tables = {
            field.name: torch.stack([getattr(row, field.name) for row, _ in rows]) for field in fields(FaceReading)
        }
        write_file(path, save(tables | {"trust": torch.stack([trust for _, trust in rows])}))
    stored = load_file(path)
    trust = stored.pop("trust")
    return [FaceReading(**{name: values[row] for name, values in stored.items()}) for row in range(len(trust))], trust


def _reading(face: TrackedFace) -> tuple[FaceReading, Tensor]:
    """A tracked face as a reading whose eyes are told by their landmarks, its irises unseen."""
    marks = face.landmarks
    deviation = _HALF * (1 / face.confidence.clamp(min=1e-4) - 1).clamp(min=0).sqrt() * face.box[2]
    eyes = torch.stack([marks[36:42], marks[42:48]])
    gap = (eyes[:, [1, 2]] - eyes[:, [5, 4]]).norm(dim=-1).mean(1)
    openness = gap / (eyes[:, 0] - eyes[:, 3]).norm(dim=-1)
    shut = torch.sigmoid((_SHUT - openness) / _SHUT_WIDTH)
    seen = torch.stack([face.visibility[36:42].mean(), face.visibility[42:48].mean()])
    return FaceReading(
        marks, deviation, face.visibility, torch.tensor(face.presence), torch.full((2, 2), torch.nan),
        openness.nan_to_num(0.0), shut.nan_to_num(0.0), seen,
    ), trust_of(face.confidence, face.visibility)  # fmt: skip


def video_solver(readings: list[FaceReading], trust: Tensor, fps: float) -> Solved:
    """``VideoSolver`` on the embedded performer's mean head, as ``torchface track --live`` runs it."""
    rig = performer(texture=False)
    calibration = assumed_calibration(*SIZE)
    solver = solver_for(rig, load_track_models(rig, fps=fps), calibration)
    smoother, state, rows = LandmarkFilter(), None, []
    onto = mapping(rig.names, ARKIT)
    started = time.process_time()
    for reading, sure in zip(readings, trust, strict=True):  # a frame's state is the next one's
        shown = torch.where(sure[:, None] > 0, reading.landmarks, torch.nan)
        landmarks = smoother.step(shown)
        if state is None and int(torch.isfinite(landmarks).all(1).sum()) < _LEAST:
            rows.append(torch.zeros(len(rig.names)))
            continue
        before: VideoState = state or solver.start()
        state = solver.step(before, landmarks, confidence=sure, interval=1 / fps)
        rows.append(state.weights.detach().float())
    took = 1000 * (time.process_time() - started) / len(readings)
    weights = torch.stack(rows) @ onto.T
    return Solved(weights, gaze_of(weights), took)


SOLVERS: dict[str, Solver] = {"VideoSolver, mean head": video_solver}
