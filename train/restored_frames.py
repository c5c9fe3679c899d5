"""Captured frames as an enhancement model restores them from their smooth part, beside the truth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.enhancement import EnhancementModel
from torchface.geometry.similarity import similarity_transform
from torchface.io.meshes.mesh_sequence import MeshSequence
from torchface.progress import Progress

_MOST = 40  # frames that are measured of what was learned


@dataclass(frozen=True, eq=False)
class Restored:
    """One frame, laid on the neutral.

    Args:
        truth: as captured, (V,3), millimetres.
        smooth: its smooth part, which the model sees.
        restored: the smooth part with the model's detail.
        outside: the share of the regions for which the frame lies outside the database.
    """

    truth: Tensor
    smooth: Tensor
    restored: Tensor
    outside: float


@torch.no_grad()
def restored(model: EnhancementModel, frame: Tensor) -> Restored:
    """A frame (V,3) of the model's mesh, in any place, restored from its smooth part."""
    smooth = model.low(frame[None])
    truth = similarity_transform(frame[None], smooth, scale=False).apply(frame[None])
    found = model.enhance(truth)
    return Restored(truth[0], smooth[0], found.vertices[0], float(found.outside.float().mean()))


def measured(
    model: EnhancementModel, learned: MeshSequence, test: MeshSequence | None, progress: Progress
) -> dict[str, float]:
    """What goes into the card: the detail that restored frames lack, as a share of what their smooth part lacks."""
    metrics = {
        "frames learned from": float(len(learned)),
        "vertices": float(len(model.neutral)),
        "detail lost by compression, % of its energy": 100 * model.lost_share,
    }
    for name, frames in {"learned": learned, "held out": test}.items():
        if frames is None:
            continue
        missing, given, outside = 0.0, 0.0, []
        numbers = range(0, len(frames), max(1, len(frames) // _MOST))
        for done, number in enumerate(numbers, start=1):  # a frame at a time: they are large
            one = restored(model, frames.read(number, number + 1)[0])
            missing += float((one.restored - one.truth).square().sum())
            given += float((one.smooth - one.truth).square().sum())
            outside.append(one.outside)
            progress(f"measuring, {name}", done, len(numbers))
        metrics[f"{name}: missing detail, of the smooth part's"] = (missing / max(given, 1e-30)) ** 0.5
        metrics[f"{name}: regions outside the database, %"] = 100 * sum(outside) / len(outside)
    return metrics
