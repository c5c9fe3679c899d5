"""When skin folds: how far each wrinkle has folded, from the compression across it and from what went before."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.shape_names import mirror

_LEAST_COMPRESSION = 0.04
"""Below it a rig's largest compression is taken to be this: no wrinkle comes from noise."""


def steady_folding(compression: Tensor, scale: Tensor, trace: Tensor) -> Tensor:
    """How far skin folds that is held compressed, in [0,1], (T,G).

    Args:
        compression: across each line, 1 minus the stretch, (T,G); negative where skin is stretched.
        scale: the compression at which 1 - 1/e of the way is done, (G,).
        trace: folding at rest, (G,); stretching takes it away.
    """
    folded = 1 - (-compression.clamp(min=0) / scale).exp()
    flattened = (compression.clamp(max=0) / scale).exp()
    return (trace + (1 - trace) * folded) * flattened


def with_lag(folding: Tensor, fps: float, fold_time: float, unfold_time: float) -> Tensor:
    """Folding (T,G) as skin shows it: a first-order low-pass, fast as it folds and slow as it unfolds.

    Args:
        folding: what it would be held still; the first frame is taken to have been held.
        fps: frames a second.
        fold_time: time constant of folding, seconds.
        unfold_time: time constant of unfolding, seconds.
    """
    fold, unfold = (1 - math.exp(-1 / (fps * time)) for time in (fold_time, unfold_time))
    shown = torch.empty_like(folding)
    shown[:1] = folding[:1]
    for frame in range(1, len(folding)):  # each frame depends on the one before
        change = folding[frame] - shown[frame - 1]
        shown[frame] = shown[frame - 1] + torch.where(change > 0, fold * change, unfold * change)
    return shown


def extreme_weights(names: Sequence[str]) -> Tensor:
    """Every shape alone at weight 1, and every one together with its mirror image, (E,N)."""
    single = torch.eye(len(names))
    pair = (single + single[mirror(names)]).clamp(max=1)
    return torch.cat([single, pair]).unique(dim=0)


def compression_scale(extremes: Tensor, line: Tensor, places: Sequence[str]) -> Tensor:
    """The compression that folds each line's skin by 1 - 1/e: half of what the rig's own extremes reach, (G,).

    So a rig that compresses skin less than skin does still wrinkles.

    Args:
        extremes: compression at every gauge in the rig's extremes, (E,G).
        line: which line each gauge belongs to, (G,) int64.
        places: name of each line's place; lines of one name share a scale.
    """
    most = extremes.amax(0)
    scale = torch.empty_like(most)
    for place in set(places):
        of_place = torch.tensor([name == place for name in places])[line]
        scale[of_place] = 0.5 * most[of_place].quantile(0.7).clamp(min=_LEAST_COMPRESSION)
    return scale
