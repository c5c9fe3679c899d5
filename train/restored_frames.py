"""Captured frames as an enhancement model restores them from what a coarse animation shows, beside the truth."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.enhancement import EnhancementModel
from torchface.geometry.similarity import similarity_transform
from torchface.io import MeshSequence
from torchface.progress import Progress

_MOST = 40  # frames that are measured of what was learned


@dataclass(frozen=True, eq=False)
class Shown:
    """Captured frames, and what a coarse animation shows of each where that is known."""

    truth: MeshSequence
    coarse: MeshSequence | None  # the same frames in the same places, coarse; their own smooth part if None

    def __len__(self) -> int:
        return len(self.truth)


@dataclass(frozen=True, eq=False)
class Restored:
    """One frame, aligned with the neutral."""

    truth: Tensor  # as captured, (V,3), millimetres
    smooth: Tensor  # what the model sees: its smooth part, or the coarse animation
    restored: Tensor
    outside: float  # the share of the regions for which the frame lies outside the database


@torch.no_grad()
def restored(model: EnhancementModel, frames: Shown, number: int) -> Restored:
    """A frame of the model's mesh, in any place, restored."""
    truth = frames.truth.read(number, number + 1)
    if frames.coarse is None:
        smooth = model.low(truth)
        truth = similarity_transform(truth, smooth, scale=False).apply(truth)
        found = model.enhance(truth)
    else:
        smooth = frames.coarse.read(number, number + 1)
        pose = similarity_transform(smooth, model.neutral[None], scale=False)
        truth, smooth = pose.apply(truth), pose.apply(smooth)
        found = model.enhance(smooth)
    return Restored(truth[0], smooth[0], found.vertices[0], float(found.outside.float().mean()))


def measured(model: EnhancementModel, learned: Shown, test: Shown | None, progress: Progress) -> dict[str, float]:
    """What goes into the card: the detail that restored frames lack, as a share of what the model is shown lacks."""
    metrics = {
        "frames learned from": float(len(learned)),
        "vertices": float(len(model.neutral)),
        "detail lost by compression, % of its energy": 100 * model.lost_share,
    }
    of = "the smooth part's" if learned.coarse is None else "the coarse frames'"
    for name, frames in {"learned": learned, "held out": test}.items():
        if frames is None:
            continue
        missing, given, outside = 0.0, 0.0, []
        numbers = range(0, len(frames), max(1, len(frames) // _MOST))
        for done, number in enumerate(numbers, start=1):  # a frame at a time: they are large
            one = restored(model, frames, number)
            missing += float((one.restored - one.truth).square().sum())
            given += float((one.smooth - one.truth).square().sum())
            outside.append(one.outside)
            progress(f"measuring, {name}", done, len(numbers))
        metrics[f"{name}: missing detail, of {of}"] = (missing / max(given, 1e-30)) ** 0.5
        metrics[f"{name}: regions outside the database, %"] = 100 * sum(outside) / len(outside)
    return metrics
