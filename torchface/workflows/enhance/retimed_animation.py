"""A coarse animation in the actor's timing, read piece by piece as it was before."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchface.enhancement.animation_retiming import at_moments, retimed_moments
from torchface.enhancement.enhancement_model import EnhancementModel
from torchface.progress import Progress
from torchface.workflows.enhance.coarse_animation import CoarseAnimation
from torchface.workflows.enhance.enhanced_frames import piece_size


def retimed_animation(animation: CoarseAnimation, model: EnhancementModel, progress: Progress) -> CoarseAnimation:
    """The animation with its keyframes where they are, and the motions between them in the actor's timing.

    Raises:
        TorchfaceError: a frame cannot be read.
    """
    step, features = piece_size(len(model.neutral)), []
    for begin in range(0, animation.count, step):
        progress("reading for the timing", begin, animation.count)
        with torch.no_grad():
            features.append(model.features(animation.read(begin, min(begin + step, animation.count))))
    progress("timing the motions between keyframes")
    moments = retimed_moments(model, torch.cat(features), animation.fps)
    shares = model.vertex_weights

    def read(begin: int, end: int) -> Tensor:
        asked = moments[:, begin:end]
        first = math.floor(float(asked.min()))
        last = min(math.ceil(float(asked.max())) + 1, animation.count)
        return at_moments(animation.read(first, last), asked - first, shares)

    note = shift_note((moments - torch.arange(animation.count)).abs() / animation.fps, model.region_names)
    return replace(animation, read=read, notes=(*animation.notes, note))


def shift_note(shifts: Tensor, names: Sequence[str]) -> str:
    """How far regions' frames (R,T) were moved in time, seconds, in words."""
    if not float(shifts.max()) > 0:
        return "retimed: no motion between keyframes was found; the timing is the input's"
    furthest = shifts.amax(1)
    region, moved = int(furthest.argmax()), shifts > 0
    return (
        f"retimed: motions between keyframes take the actor's timing; {float(moved.any(0).float().mean()):.0%} of the "
        f"frames show another moment, {float(shifts[moved].mean()):.2f} s away in the mean and at most "
        f"{float(furthest[region]):.2f} s ({names[region]})"
    )
