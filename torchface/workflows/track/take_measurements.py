"""Measurements of a take beside its landmarks, from what networks read of its frames."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchface.capture.own_rig import FaceMeasurements, VideoSolver
from torchface.capture.own_rig.surface_offsets import surface_offsets
from torchface.capture.weight_readings import WeightReadings
from torchface.geometry.cameras.distortion import undistort
from torchface.landmarks.images.face_reading import FaceReading, trust_of
from torchface.temporal.adaptive_kalman import LANDMARK_SETTINGS, adaptive_filter
from torchface.workflows.track.track_inputs import TrackInputs

# What landmarks are off by beside what networks expect of the 68, in rendered films of people; the floor is what they
# are off by alike, a share of the eyes' distance.
_UNDERSTATED, _FLOOR = 2.0, 0.01


def take_measurements(inputs: TrackInputs, solver: VideoSolver, reading: FaceReading) -> FaceMeasurements | None:
    """What a take's reading (T,...) says beside the landmarks; None where it comes of no network."""
    if inputs.models.finder is None or not bool(torch.isfinite(reading.deviation).any()):
        return None
    deviation = (_UNDERSTATED * reading.deviation).nan_to_num(0.0, posinf=1e6)
    points, spread = None, None
    if solver.surface_rest is not None and reading.points.shape[-2] == len(solver.surface_rest):
        found = torch.where(torch.isfinite(reading.point_deviation)[..., None], reading.points, torch.nan)
        points = adaptive_filter(undistort(found.double(), inputs.calibration), LANDMARK_SETTINGS).float()
        spread = reading.point_deviation
    read = None
    if bool(torch.isfinite(reading.expression_deviation).any()):
        read = WeightReadings.of_expression(reading.expression, reading.expression_deviation, solver.names)
    return FaceMeasurements(deviation, points, spread, read)


def measuring_solver(
    solver: VideoSolver, landmarks: Tensor, reading: FaceReading, measured: FaceMeasurements
) -> tuple[VideoSolver, Tensor]:
    """The solver for a take's measurements, and how far its landmarks are trusted beside their deviations, (T,68)."""
    known = (torch.isfinite(reading.deviation) & torch.isfinite(landmarks).all(-1)).to(reading.deviation)
    trust = trust_of(known, reading.visibility.nan_to_num(0.0)) * (reading.confidence > 0)
    offsets = surface_offsets(solver, landmarks, reading.trust, measured)
    if offsets is not None:
        solver = solver.with_surface_moved(offsets)
    settings = replace(solver.settings, relative_noise=min(solver.settings.relative_noise, _FLOOR))
    return solver.with_settings(settings), trust
