"""Signals of the eyes from openness, irises and corners: how far lids are open, and where the eyes look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.anybody.webcam_state import WebcamState

# Corners of the right eye and the left one, and the lids' landmarks across from each other, among the 68.
CORNERS = ((36, 39), (42, 45))
_LIDS = (((37, 41), (38, 40)), ((43, 47), (44, 46)))
LOOKS = (
    *("eyeLookInRight", "eyeLookOutRight", "eyeLookInLeft", "eyeLookOutLeft"),
    *("eyeLookUpRight", "eyeLookDownRight", "eyeLookUpLeft", "eyeLookDownLeft"),
)
"""The shapes that turn the eyes, in the order of :func:`look_weights`."""
SIDEWAYS, UPWARD = 0.52, 0.45
"""Rotation of an eye at weight 1, radians: 30 degrees to the side, 26 up and down."""

# Millimetres: an eyeball's middle lies behind the middle of its corners, above it and further out; its iris before it.
_BEHIND, _ABOVE, _OUTWARD, _IRIS = 9.5, 1.8, 1.8, 11.5
_WIDEST = 0.9 * _IRIS
_STRAYS = 0.35  # radians: what is further to the side or up is no looking straight ahead
_SHUT = 0.05
_SURELY_OPEN, _SURELY_SHUT = 0.3, 0.9
_LEAST_OPEN = 0.35  # of an eye that is surely not shut
_UNSEEN = 0.3  # of an eye that is hidden, its twin's openness counts for less
_OPEN_MEMORY, _SHUT_MEMORY, _STRAIGHT_MEMORY = 8.0, 2.0, 60.0  # seconds
_LASTING, _ASKED = 0.3, 10.0  # who is asked to rest looks ahead: that counts as much as ten times as long without
_STRAIGHT_PRIOR, _SHUT_PRIOR = 1.0, 0.2  # seconds
_NARROWEST = 0.15
_DOWNWARD = 0.2  # how quickly the open level falls beside how it rises: blinks and squints are no level


@dataclass(frozen=True, eq=False)
class EyeSignals:
    """Signals of the eyes in a frame, the person's right one first.

    Args:
        open: openness beside the person's own, 1 open as at rest, 0 shut, (2,).
        open_trust: how much that counts, (2,) in [0,1].
        gaze: (2,2) radians, to the person's left and up, beside the head and beside straight ahead.
        gaze_trust: (2,) in [0,1].
        lids, lids_seen, straight, straight_seen: as of ``WebcamState``, with this frame.
    """

    open: Tensor
    open_trust: Tensor
    gaze: Tensor
    gaze_trust: Tensor
    lids: Tensor
    lids_seen: Tensor
    straight: Tensor
    straight_seen: Tensor


def openness_of(landmarks: Tensor) -> Tensor:
    """The distance of the lids over that of the eye's corners, (B,2), of landmarks (B,68,C)."""
    eyes = []
    for (right, left), pairs in zip(CORNERS, _LIDS, strict=True):
        apart = sum((landmarks[:, a] - landmarks[:, b]).norm(dim=-1) for a, b in pairs) / len(pairs)
        eyes.append(apart / (landmarks[:, right] - landmarks[:, left]).norm(dim=-1))
    return torch.stack(eyes, dim=1)


def openness_rows(rest: Tensor, basis: Tensor, names: Sequence[str]) -> tuple[Tensor, Tensor]:
    """What a unit of each shape adds to each eye's openness, 0 shut and 1 at rest, (2,N); and the rig's at rest, (2,).

    Args:
        rest, basis: of the 68 landmarks, (68,3) and (68,3,N).
        names: of the shapes.
    """
    at_rest = openness_of(rest[None])[0]
    moved = openness_of((rest[..., None] + basis).permute(2, 0, 1)).T - at_rest[:, None]
    blinks = [names.index(f"eyeBlink{side}") if f"eyeBlink{side}" in names else -1 for side in ("Right", "Left")]
    way = torch.stack([-moved[eye, row] if row >= 0 else at_rest[eye] for eye, row in enumerate(blinks)])
    return moved / way[:, None], at_rest


def seen_gaze(rays: Tensor, iris: Tensor, rotation: Tensor, depth: Tensor) -> Tensor:
    """Where the eyes look beside the head, (2,2) radians: to the person's left, up.

    The line of sight goes from the middle of an eyeball, which lies behind the middle of the eye's corners, through
    the iris.

    Args:
        rays: of the 68 landmarks, (68,2), at depth 1.
        iris: of the irises, (2,2).
        rotation: head to camera, (3,3).
        depth: of the eyes, (2,), millimetres.
    """
    middle = torch.stack([0.5 * (rays[a] + rays[b]) for a, b in CORNERS])
    out = torch.stack([-rotation[:2, 0], rotation[:2, 0]])
    centre = _OUTWARD * out + _ABOVE * rotation[:2, 1] - _BEHIND * rotation[:2, 2]
    across = (iris - middle) * depth[:, None] - centre
    length = across.square().sum(1, keepdim=True).sqrt()
    across = across * (_WIDEST / length.clamp(min=_WIDEST))
    toward = -(_IRIS**2 - across.square().sum(1, keepdim=True)).sqrt()
    sight = torch.cat([across, toward], dim=1) @ rotation / _IRIS
    up = sight[:, 1].clamp(-0.95, 0.95)
    side = (sight[:, 0] / (1 - up.square()).sqrt()).clamp(-0.95, 0.95)
    # ONNX Runtime has the arc sine of float32 alone.
    return torch.asin(torch.stack([side, up], dim=1).float()).to(rays)


def look_weights(gaze: Tensor) -> Tensor:
    """Weights of ``LOOKS``, (8,) in [0,1], of gaze (2,2)."""
    side, up = gaze[:, 0] / SIDEWAYS, gaze[:, 1] / UPWARD
    # To the person's left is toward the nose for the right eye.
    made = [side[0], -side[0], -side[1], side[1], up[0], -up[0], up[1], -up[1]]
    return torch.stack(made).clamp(0, 1)


@dataclass(frozen=True, eq=False)
class EyesRead:
    """What a picture shows of both eyes, each (2,), NaN where nobody said.

    Args:
        openness, closed, visibility: as of a ``FaceReading``.
    """

    openness: Tensor
    closed: Tensor
    visibility: Tensor


def eye_signals(
    read: EyesRead,
    gaze: Tensor,
    usual: Tensor,
    looking: Tensor,
    before: WebcamState,
    interval: Tensor,
    pose: Tensor,
    learns: Tensor,
) -> EyeSignals:
    """A frame's signals, beside what has been learned of the person's eyes, and what that becomes.

    Args:
        read: of the frame.
        gaze: where the eyes seem to look, (2,2), NaN where nobody said.
        usual: openness of eyes at rest, (2,).
        looking: what looking up or down adds to the rig's openness at weights (8,) of ``LOOKS``, (2,8).
        before: the state of the frame before.
        interval: seconds since then, ().
        pose: what the person has been asked to hold, () of ``POSES``.
        learns: 0 where nothing is to be learned, ().
    """
    openness, closed, visibility = read.openness, read.closed, read.visibility
    known = ~torch.isnan(openness)
    opening = torch.where(known, openness, usual)
    shut = torch.where(torch.isnan(closed), 0.0, closed)
    visible = torch.where(torch.isnan(visibility), 1.0, visibility).clamp(0, 1)
    resting, shutting = (pose - 1).abs() < 0.5, (pose - 5).abs() < 0.5

    looks = ~torch.isnan(gaze).any(1)
    seen = torch.where(looks[:, None], gaze, 0.0)
    gaze_trust = looks * visible * (1 - shut)
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

    level, floor = usual + before.lids[:, 0], _SHUT + before.lids[:, 1]
    span = (level - floor).clamp(min=0.03)
    by_look = 1 + looking @ look_weights(ahead) * any_gaze
    part = (opening - floor) / span
    rested = floor + (opening - floor) / by_look.clamp(min=0.4)
    # Narrow eyes stay so, blinks do not: what is far below the level counts, and moves it slowly.
    counts = learns * known * visible * (shut < _SURELY_OPEN) * (part > _NARROWEST) * ~shutting
    falls = torch.where(resting, 1.0, torch.where(rested < level, _DOWNWARD, 1.0))
    lid_rate = counts * falls * interval / (before.lids_seen[:, 0].clamp(max=_OPEN_MEMORY) + interval)
    opened = before.lids[:, 0] + lid_rate * (rested - level)
    is_shut = learns * known * visible * ((shut > _SURELY_SHUT) | (shutting & (part < 0.6)))
    shut_rate = is_shut * interval / (before.lids_seen[:, 1].clamp(max=_SHUT_MEMORY) + _SHUT_PRIOR + interval)
    closes = before.lids[:, 1] + shut_rate * (opening - floor)
    lids = torch.stack([opened, closes], dim=1)
    lids_seen = before.lids_seen + interval * torch.stack([counts, is_shut], dim=1)

    sure = ((shut - 0.5) / (_SURELY_SHUT - 0.5)).clamp(0, 1)
    least = _LEAST_OPEN * (1 - shut / _SURELY_OPEN).clamp(0, 1) * ~torch.isnan(closed)
    part = torch.maximum(part, least) * (1 - sure)
    trust = known * visible
    twin, twin_trust = part.flip(0), _UNSEEN * trust.flip(0)
    total = trust + twin_trust * (1 - trust)
    part = (trust * part + twin_trust * (1 - trust) * twin) / total.clamp(min=1e-6)
    return EyeSignals(part.clamp(-0.1, 1.8), total, ahead, any_gaze, lids, lids_seen, straight, straight_seen)
