"""What someone before a webcam does: faces from a take, a head that never rests, turning away, a hand at the mouth."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.rotations import rotation_matrix
from torchface.shape_names import ARKIT
from torchface.synthetic.stages.weight_curves import GESTURES, perform, raised_cosine

from .turned_eyes import FULL_GAZE

_MOUTH = ("jaw", "mouth")
_AWAY = 105.0  # degrees that a head turns away: no face is left to be seen
_TURNING, _TURNED = 0.5, 0.7  # seconds on the way there or back, and away
_RAISING, _RAISED = 0.25, 0.9  # seconds that a hand takes to the mouth, and stays there
# What a talking mouth does besides, and where between start and end; seconds of rise, hold and fall.
_ASKED = ((GESTURES["smile"], 0.1), ({"jawOpen": 0.75}, 0.72))
_ASKED_FOR = (0.25, 0.25, 0.35)
_BLINK = (0.08, 0.03, 0.16)  # seconds to close, closed, to open


@dataclass(frozen=True)
class SittingSettings:
    """How someone sits before the camera."""

    distance: float = 560.0  # from the camera to the head, millimetres
    aside: tuple[float, float] = (0.0, 0.0)  # of the head's middle from the optical axis, right and down, millimetres
    roll: float = 0.0  # of the camera, degrees
    yaw: float = 9.0  # standard deviations of the head's motion, degrees
    pitch: float = 5.0  # standard deviations of the head's motion, degrees
    tilt: float = 4.0  # standard deviations of the head's motion, degrees
    drift: float = 14.0  # of its place, millimetres


@dataclass(frozen=True, eq=False)
class WebcamPerformance:
    """Frames of someone before a webcam."""

    fps: float  # frames a second
    weights: Tensor  # of ARKit's shapes, (T,52) in [0,1]
    rotation: Tensor  # from the head to the camera, (T,3,3)
    translation: Tensor  # of the head's origin in the camera's coordinates, (T,3), millimetres
    hand: Tensor  # how far a hand has been raised to the mouth, (T,) in [0,1]; 0 where there is none

    def __len__(self) -> int:
        return len(self.weights)


def sitting(
    weights: Tensor,
    fps: float,
    generator: torch.Generator,
    settings: SittingSettings = SittingSettings(),
    away: float | None = None,
    hand: float | None = None,
) -> WebcamPerformance:
    """Someone whose head turns and sways slowly about the neck while the face goes through a take.

    Args:
        away: second at which they begin to turn away; they look back after that.
        hand: second at which a hand begins to rise to the mouth.

    Example:
        >>> still = sitting(torch.zeros(30, 52), 30.0, torch.Generator().manual_seed(0), SittingSettings(yaw=0.0))
        >>> len(still), tuple(still.rotation.shape)
        (30, (30, 3, 3))
    """
    count = len(weights)
    seconds = torch.arange(count, dtype=torch.float64) / fps
    wander = _wander(seconds, 6, generator)
    angles = wander[:, :3] * torch.tensor([settings.yaw, settings.pitch, settings.tilt])
    angles[:, 2] += settings.roll
    if away is not None:
        side = 1.0 if float(torch.rand((), generator=generator)) < 0.5 else -1.0
        angles[:, 0] += side * _AWAY * raised_cosine(seconds, away, _TURNING, _TURNED, _TURNING)
    yaw, pitch, roll = torch.deg2rad(angles).unbind(1)
    none = torch.zeros_like(yaw)
    head = (
        rotation_matrix(torch.stack([none, yaw, none], 1))
        @ rotation_matrix(torch.stack([pitch, none, none], 1))
        @ rotation_matrix(torch.stack([none, none, roll], 1))
    )
    rotation = head.new_tensor([1.0, -1.0, -1.0]).diag() @ head
    place = settings.drift * wander[:, 3:] + wander.new_tensor([*settings.aside, settings.distance])
    pivot = wander.new_tensor([0.0, -60.0, 0.0])  # a neck, below and behind the face
    translation = place - (rotation @ pivot) + pivot * wander.new_tensor([1.0, -1.0, -1.0])
    raised = none if hand is None else raised_cosine(seconds, hand, _RAISING, _RAISED, _RAISING)
    return WebcamPerformance(fps, weights.clamp(0, 1), rotation, translation, raised)


def with_speech(weights: Tensor, fps: float, generator: torch.Generator, start: float, end: float) -> Tensor:
    """Weights (T,52) of a resting mouth that talks between two seconds, and meanwhile smiles once and opens wide
    once."""
    mouth = torch.tensor([name.startswith(_MOUTH) for name in ARKIT])
    made = perform(len(weights), generator, fps).weights
    assert made is not None
    seconds = torch.arange(len(weights), dtype=torch.float64) / fps
    share = raised_cosine(seconds, start, 0.4, max(end - start - 0.8, 0.0), 0.4).float()[:, None]
    talking = torch.where(mouth, torch.maximum(weights, share * made.values[..., 0]), weights)
    for pose, place in _ASKED:
        curve = raised_cosine(seconds, start + place * (end - start), *_ASKED_FOR).float()
        for name, value in pose.items():
            row = ARKIT.index(name)
            talking[:, row] = torch.maximum(talking[:, row], value * curve)
    return talking


def with_blinks(weights: Tensor, fps: float, seconds: tuple[float, ...]) -> Tensor:
    """Weights (T,52) with full blinks that begin at some seconds."""
    time = torch.arange(len(weights), dtype=torch.float64) / fps
    lids = [ARKIT.index(f"eyeBlink{side}") for side in ("Left", "Right")]
    blinking = weights.clone()
    for start in seconds:
        shut = raised_cosine(time, start, *_BLINK).to(weights)[:, None]
        blinking[:, lids] = torch.maximum(blinking[:, lids], shut)
    return blinking


def gaze_of(weights: Tensor) -> Tensor:
    """Where eyes look that have ARKit's weights (...,52), (...,2,2) radians; see ``turned_eyes.gaze_weights``."""
    rows = []
    for side, left, right in (("Right", "In", "Out"), ("Left", "Out", "In")):
        way = {name: weights[..., ARKIT.index(f"eyeLook{name}{side}")] for name in ("In", "Out", "Up", "Down")}
        across, up = way[left] - way[right], way["Up"] - way["Down"]
        rows.append(torch.stack([across * math.radians(FULL_GAZE[0]), up * math.radians(FULL_GAZE[1])], -1))
    return torch.stack(rows, -2)


def _wander(seconds: Tensor, tracks: int, generator: torch.Generator, waves: int = 5) -> Tensor:
    """Smooth random curves (T,K) of about unit size, between 0.08 and 0.6 Hz."""
    draw = torch.rand(2, waves, tracks, generator=generator, dtype=torch.float64)
    rate = 0.08 * (0.6 / 0.08) ** draw[0]
    size = (0.08 / rate) ** 0.35
    phase = 2 * math.pi * (rate * seconds[:, None, None] + draw[1])
    return (size * phase.sin()).sum(1) * math.sqrt(2 / waves)
