"""Outputs of a webcam's frames: weights by ARKit's names, held and relaxed without a face, calmed with one."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.capture.antagonist_shapes import signed_difference
from torchface.capture.anybody.guided_gains import gain_factors
from torchface.capture.anybody.webcam_state import WebcamState
from torchface.capture.own_rig.eye_geometry import with_following_lids
from torchface.geometry.rotations import rotation_matrix
from torchface.temporal.one_euro import WEBCAM_ONE_EURO, one_euro_step

_HOLD, _RELAX = 0.3, 0.5
"""For how long a lost face is held, and how long it then takes to rest, seconds."""
_MISFIT, LOST_FIT = 0.06, 0.14  # of the eyes' distance
OCTAVES = 4.0
"""Of the filter's cutoff, between no smoothing to speak of and the most."""


@dataclass(frozen=True, eq=False)
class OutputTables:
    """What outputs are made by."""

    gain_shapes: Tensor  # which shapes each gain is of, as `gain_factors` wants them
    to_arkit: Tensor  # from the rig's weights to ARKit's, (52,N)
    filter_units: Tensor  # what counts as one in the filter, of weights, radians and millimetres, (58,)
    signed: Tensor  # of ARKit's antagonists, see `signed_quantities`, (K,52)
    followers: Tensor  # see `lid_followers`, (3,2,52)


def lost_state(before: WebcamState, interval: Tensor) -> WebcamState:
    """The state of a frame without a face: as it was, then on its way to rest."""
    lost = before.lost + interval
    left = (_HOLD + _RELAX - before.lost).clamp(max=_RELAX)
    left_now = (_HOLD + _RELAX - lost).clamp(min=0, max=_RELAX)
    share = torch.where(left > 0, left_now / left.clamp(min=1e-6), 0.0)
    return replace(
        before,
        weights=before.weights * share,
        shapes=before.shapes * share,
        gaze=before.gaze * share,
        speeds=torch.zeros_like(before.speeds),
        shown=torch.zeros_like(before.shown),
        tracked=torch.zeros_like(before.tracked),
        lost=torch.where((before.pose.abs().sum() > 0), lost, 0.0),
    )


def calmed_state(
    outputs: OutputTables,
    after: WebcamState,
    before: WebcamState,
    has_face: Tensor,
    present: Tensor,
    interval: Tensor,
    gain: Tensor,
    smoothing: Tensor,
) -> WebcamState:
    """The state with its outputs: weights by ARKit's names with gains, calmed."""
    gains = gain_factors(after.gains, outputs.gain_shapes)
    weights = (gain * (outputs.to_arkit @ (after.shapes / gains))).clamp(0, 1)
    weights = with_following_lids(weights, outputs.followers)
    pose = after.pose
    first = (before.pose.abs().sum() < 1e-9) | (after.shown < 1.5 * interval)
    turned = pose[:9].reshape(3, 3)
    # The sine of the turn for the turn: between two frames it is small.
    apart = 0.5 * (turned @ before.rotation.T - before.rotation @ turned.T)
    turn = torch.stack([apart[2, 1], apart[0, 2], apart[1, 0]])
    motion = torch.cat([turn, pose[9:] - before.translation])
    speeds = torch.where(first, 0.0, before.speeds)
    old = torch.cat([before.weights, torch.zeros_like(motion)])
    unit = outputs.filter_units
    latest, opening = torch.cat([weights, motion]), torch.exp2(OCTAVES * (0.5 - smoothing))
    calm, speeds = one_euro_step(latest, old, speeds, interval, WEBCAM_ONE_EURO, unit, opening)
    calm = torch.where(smoothing > 0, calm, latest)
    rotation = torch.where(first, turned, rotation_matrix(calm[-6:-3]) @ before.rotation)
    translation = torch.where(first, pose[9:], before.translation + calm[-3:])
    fit = ((LOST_FIT - after.error) / (LOST_FIT - _MISFIT)).clamp(0, 1)
    return replace(
        after,
        weights=torch.where(has_face, signed_difference(calm[:-6].clamp(0, 1), outputs.signed), after.weights),
        rotation=torch.where(has_face, rotation, before.rotation),
        translation=torch.where(has_face, translation, before.translation),
        speeds=torch.where(has_face, speeds, after.speeds),
        tracked=torch.where(has_face, present * fit, 0.0),
    )
