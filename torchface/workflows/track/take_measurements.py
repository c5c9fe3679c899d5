"""Measurements of a take beside its landmarks, from what networks read of its frames."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchface.capture.own_rig import FaceMeasurements, VideoSolver
from torchface.capture.weight_readings import WeightReadings
from torchface.landmarks.images.face_reading import FaceReading, trust_of
from torchface.workflows.track.track_inputs import TrackInputs

# What landmarks are off by beside what networks expect of the 68, in rendered films of people; the floor is what they
# are off by alike, a share of the eyes' distance.
_UNDERSTATED, _FLOOR = 2.0, 0.01


def take_measurements(inputs: TrackInputs, solver: VideoSolver, reading: FaceReading) -> FaceMeasurements | None:
    """What a take's reading (T,...) says beside the landmarks; None where it comes of no network."""
    if inputs.models.finder is None or not bool(torch.isfinite(reading.deviation).any()):
        return None
    deviation = (_UNDERSTATED * reading.deviation).nan_to_num(0.0, posinf=1e6)
    read = None
    if bool(torch.isfinite(reading.expression_deviation).any()):
        read = WeightReadings.of_expression(reading.expression, reading.expression_deviation, solver.names)
    return FaceMeasurements(deviation, read)


def measuring_solver(solver: VideoSolver, landmarks: Tensor, reading: FaceReading) -> tuple[VideoSolver, Tensor]:
    """The solver for a take's measurements, and how far its landmarks are trusted beside their deviations, (T,68)."""
    known = (torch.isfinite(reading.deviation) & torch.isfinite(landmarks).all(-1)).to(reading.deviation)
    trust = trust_of(known, reading.visibility.nan_to_num(0.0)) * (reading.confidence > 0)
    settings = replace(solver.settings, relative_noise=min(solver.settings.relative_noise, _FLOOR))
    return solver.with_settings(settings), trust
