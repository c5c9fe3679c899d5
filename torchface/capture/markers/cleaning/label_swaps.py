"""Pairs of markers whose labels were exchanged for a stretch of frames."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.markers.cleaning.robust_prediction import Prediction

# Seconds: a stretch continues over frames without votes while neither marker is an inlier.
_MAX_GAP = 0.25


@dataclass(frozen=True)
class Swap:
    """Rows of two markers whose labels are exchanged from frame ``first`` to before ``last``."""

    markers: tuple[int, int]
    first: int
    last: int


def find_swaps(seen: Tensor, prediction: Prediction, fps: float) -> list[Swap]:
    """Stretches in which two markers are each at the other's expected place.

    An outlier that is nearer to another marker's expected place than to any other, within that one's limit,
    votes for an exchange of the two, unless the other marker is an inlier in that frame. Votes of a pair
    in consecutive frames make a stretch; a stretch counts with votes of both markers, or three of one.

    Args:
        seen: markers in rig space, (T,M,3), NaN for not seen.
        prediction: of these markers.
        fps: frames a second.
    """
    outlier = prediction.outliers
    inlier = ~torch.isnan(prediction.distance) & ~outlier
    frame, marker = outlier.nonzero(as_tuple=True)
    if not len(frame):
        return []
    distance = (seen[frame, marker][:, None] - prediction.expected[frame]).norm(dim=-1)
    distance[torch.arange(len(frame)), marker] = torch.inf
    nearest, other = distance.min(1)
    good = (nearest <= prediction.limit[other]) & ~inlier[frame, other]
    votes: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for t, a, b in zip(frame[good].tolist(), marker[good].tolist(), other[good].tolist(), strict=True):
        votes.setdefault((min(a, b), max(a, b)), []).append((t, a))
    gap = max(1, round(_MAX_GAP * fps))
    swaps = []
    for (a, b), found in votes.items():  # pairs are few: only those with votes
        fits = inlier[:, [a, b]].any(1)
        stretch: list[tuple[int, int]] = []
        for t, voter in [*sorted(found), (len(outlier) + gap + 1, -1)]:
            if stretch and (t - stretch[-1][0] > gap or bool(fits[stretch[-1][0] + 1 : t].any())):
                if len({who for _, who in stretch}) == 2 or len(stretch) >= 3:
                    swaps.append(Swap((a, b), stretch[0][0], stretch[-1][0] + 1))
                stretch = []
            stretch.append((t, voter))
    return sorted(swaps, key=lambda swap: (swap.first, swap.markers))


def swapped_back(seen: Tensor, swaps: list[Swap]) -> Tensor:
    """A copy of markers (T,M,3) with the labels of these stretches exchanged again."""
    repaired = seen.clone()
    for swap in swaps:
        stretch, pair = slice(swap.first, swap.last), list(swap.markers)
        repaired[stretch, pair] = repaired[stretch, pair[::-1]]
    return repaired
