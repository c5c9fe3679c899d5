"""Weights of people who talk, listen and feel, made by code: action units go together as in people.

The facial action coding system says which muscle moves what, its emotion dictionary which action units an emotion has,
and coded films how often people use them. Episodes draw action units, a table gives each unit's part in ARKit's shapes.
Both sides move alike, antagonists exclude each other, lids follow gaze.

``torchface.synthetic.perform`` plays gestures one by one, as an actor is asked for them; priors learn from this one.

Source: Ekman, Friesen and Hager 2002 (units, emotions); Mavadati et al. 2013 (DISFA) and Zhang et al. 2014 (BP4D) for
shares of frames and for units that go together; Evinger et al. 1991 (blinks), Malik et al. 2003 (lids and gaze).
"""

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from torchface.shape_names import ARKIT
from torchface.synthetic.stages.weight_curves import raised_cosine
from torchface.take import Take, Track

SHAPES: dict[str, dict[str, float]] = {
    "AU1": {"browInnerUp": 1.0},
    "AU2": {"browOuterUp": 1.0, "browInnerUp": 0.45},
    "AU4": {"browDown": 1.0, "eyeSquint": 0.15},
    "AU5": {"eyeWide": 1.0},
    "AU6": {"cheekSquint": 0.6, "eyeSquint": 0.5, "noseSneer": 0.15},
    "AU7": {"eyeSquint": 0.9, "eyeBlink": 0.1, "cheekSquint": 0.15},
    "AU9": {"noseSneer": 1.0, "browDown": 0.35, "cheekSquint": 0.35, "mouthUpperUp": 0.2},
    "AU10": {"mouthUpperUp": 0.9, "noseSneer": 0.3, "cheekSquint": 0.15},
    "AU12": {"mouthSmile": 1.0, "cheekSquint": 0.25, "mouthDimple": 0.15, "mouthStretch": 0.1},
    "AU14": {"mouthDimple": 0.8, "mouthPress": 0.2},
    "AU15": {"mouthFrown": 1.0},
    "AU16": {"mouthLowerDown": 1.0, "jawForward": 0.15},
    "AU17": {"mouthShrugLower": 1.0, "mouthShrugUpper": 0.7, "mouthRollLower": 0.5, "cheekPuff": 0.05},
    "AU18": {"mouthPucker": 1.0, "mouthClose": 0.15},
    "AU20": {"mouthStretch": 1.0, "mouthDimple": 0.15, "jawForward": 0.1},
    "AU22": {"mouthFunnel": 1.0, "mouthPucker": 0.15},
    "AU24": {"mouthPress": 0.9, "mouthRollLower": 0.4, "mouthRollUpper": 0.25, "mouthShrugUpper": 0.3},
    "AU25": {"mouthLowerDown": 0.75, "mouthUpperUp": 0.35, "jawForward": 0.1},
    "AU26": {"jawOpen": 1.0, "mouthClose": 0.2},
    "AU28": {"mouthRollLower": 0.9, "mouthRollUpper": 0.7},
    "AU29": {"jawForward": 1.0},
    "AU34": {"cheekPuff": 1.0, "mouthPress": 0.4},
    "AU43": {"eyeBlink": 1.0, "eyeLookDown": 0.35},
}
"""What an action unit at its strongest is in ARKit's shapes; those with a Left and a Right stand without."""

EPISODES: dict[str, tuple[float, dict[str, float]]] = {
    "smile": (5.0, {"AU6": 0.6, "AU12": 0.8, "AU7": 0.2, "AU25": 0.2}),
    "polite smile": (4.0, {"AU12": 0.4, "AU14": 0.2, "AU6": 0.15}),
    "laugh": (4.0, {"AU6": 0.9, "AU12": 0.9, "AU7": 0.4, "AU10": 0.3, "AU25": 0.9, "AU26": 0.35, "AU20": 0.2}),
    "brow flash": (4.0, {"AU1": 0.6, "AU2": 0.7, "AU5": 0.2}),
    "surprise": (1.5, {"AU1": 0.8, "AU2": 0.8, "AU5": 0.7, "AU26": 0.5}),
    "attention": (3.0, {"AU4": 0.5, "AU7": 0.4}),
    "doubt": (2.0, {"AU17": 0.6, "AU15": 0.5, "AU1": 0.2, "AU2": 0.3}),
    "anger": (1.5, {"AU4": 0.9, "AU7": 0.5, "AU5": 0.25, "AU24": 0.6, "AU17": 0.4}),
    "sadness": (1.5, {"AU1": 0.7, "AU4": 0.4, "AU15": 0.7, "AU17": 0.5}),
    "crying": (
        1.0,
        {"AU1": 0.5, "AU4": 0.7, "AU6": 0.5, "AU7": 0.6, "AU15": 0.4, "AU17": 0.4, "AU20": 0.5, "AU25": 0.5},
    ),
    "fear": (1.0, {"AU1": 0.7, "AU2": 0.5, "AU4": 0.5, "AU5": 0.8, "AU20": 0.6, "AU25": 0.5, "AU26": 0.3}),
    "disgust": (1.5, {"AU9": 0.8, "AU10": 0.6, "AU4": 0.4, "AU7": 0.5, "AU17": 0.3}),
    "pressed lips": (3.0, {"AU24": 0.6, "AU14": 0.3, "AU17": 0.4}),
    "rolled lips": (1.0, {"AU28": 0.8, "AU26": 0.05}),
    "pout": (1.0, {"AU18": 0.7, "AU22": 0.3, "AU17": 0.3}),
    "open mouth": (1.0, {"AU26": 0.8, "AU25": 0.4, "AU16": 0.2}),
    "puffed cheeks": (0.4, {"AU34": 0.8, "AU24": 0.3}),
    "thrust jaw": (0.4, {"AU29": 0.7, "AU17": 0.3}),
    "closed eyes": (1.0, {"AU43": 1.0, "AU7": 0.2}),
}
"""Action units that go together, each at its usual strength; before them, how often they come beside the others."""

_VOWELS = (
    {"AU26": 1.0, "AU25": 0.6},
    {"AU26": 0.5, "AU20": 0.5, "AU25": 0.7},
    {"AU22": 1.2, "AU26": 0.7, "AU18": 0.3},
    {"AU18": 0.6, "AU22": 0.8, "AU26": 0.3},
    {"AU26": 0.7, "AU16": 0.5, "AU25": 0.5},
)
_CONSONANTS: tuple[dict[str, float], ...] = (
    {"AU24": 0.4},
    {"AU28": 0.4},
    {"AU28": 0.25, "AU25": 0.3},
    {"AU10": 0.3, "AU25": 0.5},
    {"AU17": 0.3, "AU22": 0.3},
    {},
)
_REST = {
    "AU1": 0.1, "AU2": 0.03, "AU4": 0.12, "AU5": 0.12, "AU6": 0.05, "AU7": 0.2, "AU9": 0.05, "AU12": 0.04, "AU14": 0.02,
    "AU15": 0.08, "AU17": 0.06, "AU20": 0.08, "AU26": 0.02, "AU28": 0.04,
}  # fmt: skip
"""Mean strength of the units that people hold at rest, each person others."""

_SIDES = ("Left", "Right")
_ROW = {name: row for row, name in enumerate(ARKIT)}
_BLINK, _SACCADE = (0.08, 0.03, 0.17), 0.06  # seconds: to close, closed, to open; of a jump of the eyes
_ANTAGONISTS = (
    *((f"mouthSmile{side}", f"mouthFrown{side}", 0.5) for side in _SIDES),
    *((f"eyeWide{side}", f"eyeSquint{side}", 0.2) for side in _SIDES),
    *((f"eyeWide{side}", f"eyeBlink{side}", 0.5) for side in _SIDES),
    *((f"browOuterUp{side}", f"browDown{side}", 0.5) for side in _SIDES),
    *((f"eyeLookUp{side}", f"eyeLookDown{side}", 1.0) for side in _SIDES),
    ("mouthLeft", "mouthRight", 1.0),
    ("jawLeft", "jawRight", 1.0),
    ("cheekPuff", "mouthFunnel", 0.5),
)


def converse(frames: int, generator: torch.Generator, fps: float = 60.0) -> Take:
    """A take of another person each time, who talks, listens and feels: names are ARKit's 52, values (T,52,1) in
    [0,1]."""
    draw = _Draws(generator, frames / fps)
    seconds = torch.arange(frames) / fps
    units = _speech(seconds, draw)
    _play_episodes(units, seconds, draw)
    weights = torch.zeros(frames, len(ARKIT))
    for unit, parts in SHAPES.items():
        lean, gain = draw.uniform(-0.08, 0.08), math.exp(0.25 * draw.normal())  # a person's stronger side and ways
        curve = gain * units[unit].clamp(max=1.2)
        for name, part in parts.items():
            share = part * draw.uniform(0.7, 1.3)
            for target, side in ((name, 0.0), (f"{name}Left", lean), (f"{name}Right", -lean)):
                if target in _ROW:
                    weights[:, _ROW[target]] += share * (1 + side) * curve
    _move_aside(weights, seconds, draw)
    _look_around(weights, seconds, draw)
    _blink(weights, seconds, draw)
    for one, other, share in _ANTAGONISTS:
        first, second = weights[:, _ROW[one]].clone(), weights[:, _ROW[other]].clone()
        weights[:, _ROW[one]] = (first - share * second).clamp(min=0)
        weights[:, _ROW[other]] = (second - share * first).clamp(min=0)
    jaw, lips = _ROW["jawOpen"], _ROW["mouthClose"]
    weights[:, lips] = torch.minimum(weights[:, lips], weights[:, jaw])
    return Take(fps, weights=Track(ARKIT, weights.clamp(0, 1)[..., None]))


class _Draws:
    """Numbers from one generator, and times of events within a take."""

    def __init__(self, generator: torch.Generator, duration: float) -> None:
        self.generator, self.duration = generator, duration

    def uniform(self, low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def exponential(self, mean: float) -> float:
        return -mean * math.log(1 - self.uniform(0, 0.999))

    def normal(self) -> float:
        return float(torch.randn((), generator=self.generator))

    def choice(self, chances: Tensor) -> int:
        return int(torch.multinomial(chances, 1, generator=self.generator))

    def times(self, least: float, mean: float) -> Iterator[float]:
        """Moments that are ``least`` and a random time of this mean apart, in seconds."""
        moment = self.exponential(mean)
        while moment < self.duration:
            yield moment
            moment += least + self.exponential(mean)


def _speech(seconds: Tensor, draw: _Draws) -> dict[str, Tensor]:
    """Action units (T,): what is held at rest, and phrases of syllables, each a consonant and a vowel."""
    units = {unit: torch.full_like(seconds, min(draw.exponential(_REST.get(unit, 0.0)), 0.6)) for unit in SHAPES}
    loud = draw.uniform(0.15, 0.5)
    moment = draw.uniform(0, 3)
    until = moment + draw.uniform(1, 6)
    while moment < draw.duration:
        length = draw.uniform(0.12, 0.3)
        vowel = (_VOWELS, moment, (0.5 * length, 0.2 * length, 0.8 * length))
        consonant = (_CONSONANTS, moment - 0.06, (0.07, 0.02, 0.08))
        for sounds, start, times in (vowel, consonant):
            for unit, part in sounds[draw.choice(torch.ones(len(sounds)))].items():
                strength = loud * part * draw.uniform(0.5, 1.4)
                units[unit] = torch.maximum(units[unit], strength * raised_cosine(seconds, start, *times))
        moment += length
        if moment > until:  # a pause, then the next phrase
            moment += draw.uniform(0.3, 4.0)
            until = moment + draw.uniform(1, 6)
    return units


def _play_episodes(units: dict[str, Tensor], seconds: Tensor, draw: _Draws) -> None:
    """Raises units (T,) where emotions and signals come; a take has a mood, which prefers some."""
    kinds = [kind for _, kind in EPISODES.values()]
    mood = torch.tensor([share * draw.exponential(1.0) for share, _ in EPISODES.values()])
    moment = draw.uniform(0.0, 1.0)
    while moment < draw.duration:
        times = draw.uniform(0.15, 0.7), draw.exponential(1.2), draw.uniform(0.3, 1.2)
        strength = draw.uniform(0.15, 1.1)
        for unit, usual in kinds[draw.choice(mood)].items():
            curve = raised_cosine(seconds, moment + draw.uniform(0, 0.15), *times)
            units[unit] = torch.maximum(units[unit], strength * usual * draw.uniform(0.6, 1.3) * curve)
        moment += times[0] + times[1] + draw.exponential(0.7)


def _move_aside(weights: Tensor, seconds: Tensor, draw: _Draws) -> None:
    """Mouth and jaw go to one side, together."""
    for moment in draw.times(1.0, 6.0):
        curve = raised_cosine(seconds, moment, draw.uniform(0.15, 0.5), draw.exponential(0.5), draw.uniform(0.2, 0.6))
        side = _SIDES[draw.choice(torch.ones(2))]
        weights[:, _ROW[f"mouth{side}"]] += draw.uniform(0.0, 0.35) * curve
        weights[:, _ROW[f"jaw{side}"]] += draw.uniform(0.0, 0.25) * curve


def _look_around(weights: Tensor, seconds: Tensor, draw: _Draws) -> None:
    """Both eyes jump and rest about one direction; upper lids follow them up and down."""
    middle = draw.uniform(-0.15, 0.15), draw.uniform(-0.2, 0.35)
    x, y = middle
    across, up = torch.full_like(seconds, x), torch.full_like(seconds, y)
    for moment in draw.times(0.2, 0.8):
        reach = (0.6, 0.4) if draw.uniform(0, 1) < 0.25 else (0.12, 0.1)
        to_x, to_y = (place + draw.uniform(-far, far) for place, far in zip(middle, reach, strict=True))
        step = ((seconds - moment) / _SACCADE).clamp(0, 1)
        across, up = across + (to_x - x) * step, up + (to_y - y) * step
        x, y = to_x, to_y
    for side, inward in (("Left", -across), ("Right", across)):  # the subject's left is the viewer's right
        moves = {"eyeLookIn": inward, "eyeLookOut": -inward, "eyeLookUp": up, "eyeLookDown": -up}
        for name, amount in (moves | {"eyeBlink": -0.6 * up, "eyeWide": 0.4 * up}).items():
            weights[:, _ROW[f"{name}{side}"]] += amount.clamp(min=0)


def _blink(weights: Tensor, seconds: Tensor, draw: _Draws) -> None:
    """Both eyes close and open; behind the lids they turn down a little."""
    closed = torch.zeros_like(seconds)
    for moment in draw.times(0.3, 2.5):
        closed = torch.maximum(closed, draw.uniform(0.75, 1.0) * raised_cosine(seconds, moment, *_BLINK))
    for side in _SIDES:
        for name, most in (("eyeBlink", closed), ("eyeLookDown", 0.4 * closed)):
            row = _ROW[f"{name}{side}"]
            weights[:, row] = torch.maximum(weights[:, row], most)
        for name in ("eyeWide", "eyeLookUp"):
            weights[:, _ROW[f"{name}{side}"]] *= 1 - closed
