"""A performer does what a coach asks for: action units, alone and together, each a few times, from rest to rest."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.action_units import load_shape_table
from torchface.io.action_labels import Performed

MOVES: dict[str, dict[str, float]] = load_shape_table("arkit").units
"""What the face does for an action unit at full intensity, in ARKit's shapes."""

ACTION_UNITS: tuple[str, ...] = tuple(MOVES)

COMBINATIONS: tuple[tuple[str, ...], ...] = (("1+2", "4"), ("4", "9"), ("4", "7"), ("1+2", "18L"))
"""What is also performed together."""


@dataclass(frozen=True)
class PerformanceSettings:
    """How a coach runs the session."""

    repetitions: int = 5  # of each action unit alone
    combination_repetitions: int = 3  # of each combination
    combinations: tuple[tuple[str, ...], ...] = COMBINATIONS  # which units are done together
    fps: float = 60.0  # frames a second
    pace: float = 1.0  # 1 is unhurried, about a second a repetition; 2 twice as fast
    unevenness: float = 0.04  # standard deviation by which a repetition's left and right strengths differ
    habits: float = 0.08  # standard deviation of this performer's own strength in each shape


@dataclass(frozen=True, eq=False)
class ActionPerformance:
    """What was done, and the truth behind it."""

    names: tuple[str, ...]  # of the shapes, N
    weights: Tensor  # (T,N) in [0,1]
    units: tuple[str, ...]  # names of the action units, A
    intensities: Tensor  # (T,A) in [0,1]
    performed: tuple[Performed, ...]  # what was asked for when
    fps: float  # frames a second


def perform_action_units(
    names: Sequence[str], generator: torch.Generator, settings: PerformanceSettings = PerformanceSettings()
) -> ActionPerformance:
    """A session: first every unit alone, then the combinations, in an order drawn anew, after a second of rest."""
    names = tuple(names)

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    script: list[tuple[str, ...]] = [(unit,) for unit in ACTION_UNITS for _ in range(settings.repetitions)]
    together = [units for units in settings.combinations for _ in range(settings.combination_repetitions)]
    order = torch.randperm(len(script), generator=generator).tolist()
    order += [len(script) + i for i in torch.randperm(len(together), generator=generator).tolist()]
    script = [*script, *together]
    performed, curves, frame = [], [], round(0.5 * settings.fps)
    for number in order:  # a repetition at a time: each draws its own timing
        units = script[number]
        quick = (0.6 if units == ("45",) else 1.0) / settings.pace
        rise, hold, fall = (quick * uniform(*span) for span in ((0.18, 0.32), (0.15, 0.35), (0.2, 0.36)))
        frames = max(4, round((rise + hold + fall) * settings.fps))
        seconds = (torch.arange(frames) + 0.5) / settings.fps
        curves.append((frame, units, uniform(0.86, 1.0) * _envelope(seconds, rise, hold, fall)))
        performed.append(Performed(units, frame, frame + frames))
        frame += frames + round(uniform(0.2, 0.4) / settings.pace * settings.fps)
    total = frame + round(0.2 * settings.fps)
    intensities = torch.zeros(total, len(ACTION_UNITS))
    weights = torch.zeros(total, len(names))
    habits = 1.0 + settings.habits * torch.randn(len(names), generator=generator)
    for first, units, envelope in curves:
        stretch = slice(first, first + len(envelope))
        for unit in units:
            intensities[stretch, ACTION_UNITS.index(unit)] = envelope
            for shape, weight in MOVES[unit].items():
                row = names.index(shape)
                uneven = 1.0 + settings.unevenness * float(torch.randn((), generator=generator))
                amount = (weight * float(habits[row]) * uneven * envelope).clamp(0, 1)
                weights[stretch, row] = torch.maximum(weights[stretch, row], amount)
    weights = weights + _unrest(names, total, settings.fps, generator)
    return ActionPerformance(names, weights.clamp(0, 1), ACTION_UNITS, intensities, tuple(performed), settings.fps)


def _envelope(seconds: Tensor, rise: float, hold: float, fall: float) -> Tensor:
    up = (seconds / rise).clamp(0, 1)
    down = ((seconds - rise - hold) / fall).clamp(0, 1)
    return 0.5 * (1 - torch.cos(math.pi * up)) * 0.5 * (1 + torch.cos(math.pi * down))


def _unrest(names: tuple[str, ...], frames: int, fps: float, generator: torch.Generator) -> Tensor:
    """A face at rest: eyes that wander, a jaw and lips that are never quite still, (T,N)."""
    seconds = torch.arange(frames) / fps
    weights = torch.zeros(frames, len(names))

    def drift(size: float) -> Tensor:
        rate = 0.1 + 0.5 * torch.rand(4, generator=generator)
        phase = 2 * math.pi * torch.rand(4, generator=generator)
        return size * 0.5 * torch.sin(2 * math.pi * rate * seconds[:, None] + phase).sum(1)

    across, up, jaw, press = drift(0.2), drift(0.12), drift(0.02), drift(0.03)
    for name, curve in {
        "eyeLookInLeft": -across, "eyeLookOutLeft": across, "eyeLookInRight": across, "eyeLookOutRight": -across,
        "eyeLookUpLeft": up, "eyeLookUpRight": up, "eyeLookDownLeft": -up, "eyeLookDownRight": -up,
        "jawOpen": jaw, "mouthPressLeft": press, "mouthPressRight": press,
    }.items():  # fmt: skip
        if name in names:
            weights[:, names.index(name)] = curve.clamp(min=0)
    return weights
