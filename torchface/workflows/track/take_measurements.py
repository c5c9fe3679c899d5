"""Measurements of a take beside its landmarks, from what networks read of its frames."""

from dataclasses import replace

import torch
from torch import Tensor

from torchface.capture.own_rig import FaceMeasurements, VideoSolver
from torchface.capture.own_rig.weight_walk import counted_share
from torchface.capture.weight_readings import WeightReadings
from torchface.landmarks.images.face_reading import FaceReading, trust_of
from torchface.shape_names import ARKIT, mapping
from torchface.workflows.track.track_inputs import TrackInputs

# What landmarks are off by beside what networks expect of the 68, in rendered films of people, and what they are
# all off by at least, a share of the eyes' distance. Those of the brows err together, by how the person's brows lie.
_UNDERSTATED, _LEAST = torch.tensor([3.0 if 17 <= mark < 27 else 2.0 for mark in range(68)]), 0.01
# Weights of brows in the mean of a take, of six real ones, and their standard deviation from one to another: what a
# network reads beyond is how the person's brows lie.
_BROWS = {"browInnerUp": 0.15, "browOuterUpLeft": 0.07, "browOuterUpRight": 0.07, "browDownLeft": 0.13,
          "browDownRight": 0.13}  # fmt: skip
_OF_TAKES = 0.15
_UNSURE, _AT_A_LOSS = 0.25, 0.4  # stated deviations between which a reading becomes the training's mean


def with_own_brows(reading: FaceReading) -> FaceReading:
    r"""The reading (T,...) of a take without what the person's brows, at rest, are likely read as.

    A network's errors are alike in all frames of a person, so the mean of what it reads is

    .. math:: \bar y = m + c, \quad m \sim N(\mu, \tau^2), \quad c \sim N(0, s^2)

    with m the mean weight of takes and s the deviation that it states; c's mean, given :math:`\bar y`, is taken out as
    far as the network states that it knows little.
    """
    rows = [ARKIT.index(name) for name in _BROWS]
    read, off = reading.expression[:, rows], reading.expression_deviation[:, rows]
    known = torch.isfinite(read) & torch.isfinite(off)
    if not bool(known.any()):
        return reading
    count = known.sum(0).clamp(min=1)
    mean, variance = (x.where(known, 0.0).sum(0) / count for x in (read, off.square()))
    lost = ((variance.sqrt() - _UNSURE) / (_AT_A_LOSS - _UNSURE)).clamp(0, 1)
    own = lost * (mean - torch.tensor(list(_BROWS.values()))) * variance / (variance + _OF_TAKES**2)
    expression = reading.expression.clone()
    expression[:, rows] = read - torch.where(known.any(0), own, 0.0)
    return replace(reading, expression=expression)


def take_measurements(inputs: TrackInputs, solver: VideoSolver, reading: FaceReading) -> FaceMeasurements | None:
    """What a take's reading (T,...) says beside the landmarks; None where it comes of no network."""
    if inputs.models.finder is None or not bool(torch.isfinite(reading.deviation).any()):
        return None
    deviation = (_UNDERSTATED * reading.deviation).nan_to_num(0.0, posinf=1e6)
    read = None
    if bool(torch.isfinite(reading.expression_deviation).any()):
        to_arkit = mapping(solver.names, ARKIT) != 0
        seen = counted_share(solver.shape_confidence(measured_trust(reading.landmarks, reading).double()))
        share = (to_arkit * seen[:, None].float()).amax(2)
        read = WeightReadings.of_expression(
            reading.expression, reading.expression_deviation / share.sqrt(), solver.names
        )
    return FaceMeasurements(deviation, read)


def measuring_solver(solver: VideoSolver) -> VideoSolver:
    """The solver for measurements: what landmarks are off by is in their deviations."""
    settings = replace(solver.settings, relative_noise=min(solver.settings.relative_noise, _LEAST))
    return solver.with_settings(settings)


def measured_trust(landmarks: Tensor, reading: FaceReading) -> Tensor:
    """How far a take's landmarks are trusted beside their deviations, (T,68)."""
    known = (torch.isfinite(reading.deviation) & torch.isfinite(landmarks).all(-1)).to(reading.deviation)
    return trust_of(known, reading.visibility.nan_to_num(0.0)) * (reading.confidence > 0)
