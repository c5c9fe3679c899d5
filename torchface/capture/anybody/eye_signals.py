"""Signals of the eyes in a stream: openness and gaze beside what has been learned of the person until then."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.anybody.webcam_state import WebcamState
from torchface.capture.own_rig.eye_geometry import SURELY_OPEN, SURELY_SHUT, judged_openness, look_weights, shown_iris

_STRAYS = 0.35  # radians: what is further to the side or up is no looking straight ahead
_SHUT = 0.05
_OPEN_MEMORY, _SHUT_MEMORY, _STRAIGHT_MEMORY = 8.0, 2.0, 60.0  # seconds
_LASTING, _ASKED = 0.3, 10.0  # who is asked to rest looks ahead: that counts as much as ten times as long without
_STRAIGHT_PRIOR, _SHUT_PRIOR = 1.0, 0.2  # seconds
_NARROWEST = 0.15
_DOWNWARD = 0.2  # how quickly the open level falls beside how it rises: blinks and squints are no level


@dataclass(frozen=True, eq=False)
class EyeSignals:
    """Signals of the eyes in a frame, the person's right one first."""

    open: Tensor  # openness beside the person's own, 1 open as at rest, 0 shut, (2,)
    open_trust: Tensor  # how much that counts, (2,) in [0,1]
    gaze: Tensor  # (2,2) radians, to the person's left and up, beside the head and beside straight ahead
    gaze_trust: Tensor  # (2,) in [0,1]
    # lids, lids_seen, straight, straight_seen: as of `WebcamState`, with this frame
    lids: Tensor
    lids_seen: Tensor
    straight: Tensor
    straight_seen: Tensor

    @classmethod
    def start(cls) -> "EyeSignals":
        """Before the first frame: open, straight ahead, nothing learned."""
        one, none = torch.ones(2).double(), torch.zeros(2, 2).double()
        return cls(one, 0 * one, none, 0 * one, none, none, none, none[0, 0])


@dataclass(frozen=True, eq=False)
class EyesRead:
    """What a picture shows of both eyes, each (2,), NaN where nobody said."""

    # openness, closed, visibility: as of a `FaceReading`
    openness: Tensor
    closed: Tensor
    visibility: Tensor


def eye_signals(
    read: EyesRead,
    gaze: Tensor,
    usual: Tensor,
    looking: Tensor,
    before: WebcamState | EyeSignals,
    interval: Tensor,
    pose: Tensor,
    learns: Tensor,
) -> EyeSignals:
    """A frame's signals, beside what has been learned of the person's eyes, and what that becomes.

    Args:
        gaze: where the eyes seem to look, (2,2), NaN where nobody said.
        usual: openness of eyes at rest, (2,).
        looking: what looking up or down adds to the rig's openness at weights (8,) of ``LOOKS``, (2,8).
    """
    openness, closed, visibility = read.openness, read.closed, read.visibility
    known = ~torch.isnan(openness)
    opening = torch.where(known, openness, usual)
    shut = torch.where(torch.isnan(closed), 0.0, closed)
    visible = torch.where(torch.isnan(visibility), 1.0, visibility).clamp(0, 1)
    resting, shutting = (pose - 1).abs() < 0.5, (pose - 5).abs() < 0.5

    level, lowest = usual + before.lids[:, 0], _SHUT + before.lids[:, 1]
    span = (level - lowest).clamp(min=0.03)
    part = (opening - lowest) / span
    looks = ~torch.isnan(gaze).any(1)
    seen = torch.where(looks[:, None], gaze, 0.0)
    gaze_trust = looks * visible * (1 - shut) * shown_iris(part)
    counted = interval * torch.where(resting, _ASKED, 1.0)
    patience = counted / (before.straight_seen + _STRAIGHT_PRIOR + counted)
    rate = (learns * gaze_trust * patience.clamp(max=1.0))[:, None]
    # People look up or down for long, to the side or across only as their eyes lie otherwise than is usual.
    one = torch.ones_like(pose)
    lasting = seen.clamp(-_STRAYS, _STRAYS) * torch.stack([one, torch.where(resting, one, _LASTING * one)])
    straight = before.straight + rate * (lasting - before.straight)
    straight_seen = (before.straight_seen + learns * counted * gaze_trust.max()).clamp(max=_STRAIGHT_MEMORY)
    ahead = seen - straight
    # Both eyes look at one thing, and what they squint at the person's own nearness is learned as straight ahead.
    share = gaze_trust + 1e-3
    ahead = ((share[:, None] * ahead).sum(0) / share.sum()).expand(2, 2)
    any_gaze = gaze_trust.max().expand(2)

    by_look = 1 + looking @ look_weights(ahead) * any_gaze
    rested = lowest + (opening - lowest) / by_look.clamp(min=0.4)
    # Narrow eyes stay so, blinks do not: what is far below the level counts, and moves it slowly.
    counts = learns * known * visible * (shut < SURELY_OPEN) * (part > _NARROWEST) * ~shutting
    falls = torch.where(resting, 1.0, torch.where(rested < level, _DOWNWARD, 1.0))
    lid_rate = counts * falls * interval / (before.lids_seen[:, 0].clamp(max=_OPEN_MEMORY) + interval)
    opened = before.lids[:, 0] + lid_rate * (rested - level)
    is_shut = learns * known * visible * ((shut > SURELY_SHUT) | (shutting & (part < 0.6)))
    shut_rate = is_shut * interval / (before.lids_seen[:, 1].clamp(max=_SHUT_MEMORY) + _SHUT_PRIOR + interval)
    closes = before.lids[:, 1] + shut_rate * (opening - lowest)
    lids = torch.stack([opened, closes], dim=1)
    lids_seen = before.lids_seen + interval * torch.stack([counts, is_shut], dim=1)

    part, total = judged_openness(part, closed, known * visible)
    return EyeSignals(part.clamp(-0.1, 1.8), total, ahead, any_gaze, lids, lids_seen, straight, straight_seen)
