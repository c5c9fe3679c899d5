"""Markers whose labels were exchanged, for a stretch of frames or for the whole take."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.markers.cleaning.robust_prediction import Prediction
from torchface.capture.markers.helmet_motion import rough_motion

Votes = Mapping[tuple[int, int], Sequence[tuple[int, int]]]

# Fewer markers have no shape.
_MIN_MARKERS, _MAX_EXCHANGES = 6, 8
# Two markers are exchanged where that leaves less than this part of their distances from their places.
_NEARER = 0.5
_WHOLE_RATIO, _CENTRE_ITERATIONS = 0.25, 8
_CHUNK_FRAMES, _TRIED_FRAMES = 256, 240
# Seconds: a stretch continues over frames without votes while neither marker is an inlier.
_MAX_GAP = 0.25


@dataclass(frozen=True)
class Swap:
    """Rows of two markers whose labels are exchanged from frame ``first`` to before ``last``."""

    markers: tuple[int, int]
    first: int
    last: int


def find_swaps(seen: Tensor, prediction: Prediction, fps: float) -> list[Swap]:
    """Stretches in which two of the markers (T,M,3), in rig space, are each at the other's expected place.

    An outlier that is nearer to another marker's expected place than to any other, within that one's limit,
    votes for an exchange of the two, unless the other marker is an inlier in that frame. Votes of a pair
    in consecutive frames make a stretch; a stretch counts with votes of both markers, or three of one.
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
    fits = {pair: inlier[:, list(pair)].any(1) for pair in votes}
    return _stretches(votes, fits, max(1, round(_MAX_GAP * fps)))


def find_swaps_by_shape(markers: Tensor, fps: float) -> list[Swap]:
    """Stretches in which two of the markers (T,M,3) are each at the other's place in their own median shape.

    Two labels are in the wrong order in a frame where :math:`(y_a - y_b) \\cdot (e_a - e_b) < 0`, with markers y moved
    rigidly onto their medians e: an expression bends the face, but does not turn two markers about one another. In such
    a frame the pair that is most in the wrong order is exchanged, then the next. It holds for any share of frames below
    half.
    """
    median = _centres(markers)
    seen = ~torch.isnan(markers).any(-1)
    able = (seen.sum(1) >= _MIN_MARKERS).nonzero()[:, 0]
    known = ~torch.isnan(median).any(-1)
    if int(known.sum()) < _MIN_MARKERS or not len(able):
        return []
    moved = torch.full_like(markers, torch.nan)
    for _ in range(2):
        moved[able] = rough_motion(markers[able], median)[0].undo(markers[able])
        median = _centres(moved)
    target, place = median.nan_to_num(0.0), moved.nan_to_num(0.0)
    seen = ~torch.isnan(moved).any(-1) & known
    votes: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for rows in able.split(_CHUNK_FRAMES):
        for _ in range(_MAX_EXCHANGES):
            product = place[rows] @ target.T
            own = product.diagonal(dim1=1, dim2=2)
            order = own[:, :, None] + own[:, None] - product - product.transpose(1, 2)
            # Both must be at the other's place: else one of them has only gone astray.
            apart = torch.cdist(place[rows], target.expand(len(rows), -1, -1))
            before = apart.diagonal(dim1=1, dim2=2)
            nearer = apart + apart.transpose(1, 2) < _NEARER * (before[:, :, None] + before[:, None])
            shown = seen[rows][:, :, None] & seen[rows][:, None] & nearer
            least, pair = torch.where(shown, order, 0.0).flatten(1).min(1)
            rows, pair = rows[least < 0], pair[least < 0]
            if not len(rows):
                break
            a, b = pair // markers.shape[1], pair % markers.shape[1]
            place[rows, a], place[rows, b] = place[rows, b], place[rows, a]
            for t, low, high in zip(
                rows.tolist(), torch.minimum(a, b).tolist(), torch.maximum(a, b).tolist(), strict=True
            ):
                votes.setdefault((low, high), []).extend(((t, low), (t, high)))
    fits = {}
    for low, high in votes:
        shown = seen[:, low] & seen[:, high]
        right = torch.ones_like(shown)
        right[[t for t, _ in votes[low, high]]] = False
        if 2 * int((right & shown).sum()) < int(shown.sum()):  # the centre was the other one's: the fewer are wrong
            right = ~right
            votes[low, high] = [(t, m) for t in (shown & ~right).nonzero()[:, 0].tolist() for m in (low, high)]
        fits[low, high] = right & shown
    return _stretches(votes, fits, max(1, round(_MAX_GAP * fps)))


def whole_take_exchanges(seen: Tensor, prediction: Prediction) -> list[tuple[int, ...]]:
    """Cycles of the markers (T,M,3), in rig space, that stand at one another's expected place in most frames.

    Each marker of a cycle is an outlier in its median frame, and nearest to the expected place of the next one: within
    that one's limit, or a quarter of its distance from its own place, as weights that the exchange bent predict.
    """
    own = prediction.distance.nanmedian(0).values
    out = (own > prediction.limit).nonzero()[:, 0]
    if len(out) < 2:
        return []
    few = slice(None, None, max(1, len(seen) // _TRIED_FRAMES))
    apart = (seen[few, out, None] - prediction.expected[few][:, None, out]).norm(dim=-1)
    nearest, other = apart.nanmedian(0).values.nan_to_num(torch.inf).min(1)
    enough = torch.maximum(prediction.limit[out[other]], _WHOLE_RATIO * own[out])
    following = {int(out[i]): int(out[k]) for i, k in enumerate(other.tolist()) if nearest[i] <= enough[i] and i != k}
    cycles: list[tuple[int, ...]] = []
    for start in following:
        cycle = [start]
        while (after := following.get(cycle[-1], -1)) not in (-1, *cycle):
            cycle.append(after)
        if after == start and start == min(cycle):
            cycles.append(tuple(cycle))
    return cycles


def cycled_back(seen: Tensor, cycles: Sequence[tuple[int, ...]]) -> Tensor:
    """A copy of markers (T,M,3) in which each marker of a cycle is called like the next one."""
    repaired = seen.clone()
    for cycle in cycles:
        repaired[:, [*cycle[1:], cycle[0]]] = seen[:, list(cycle)]
    return repaired


def swapped_back(seen: Tensor, swaps: list[Swap]) -> Tensor:
    """A copy of markers (T,M,3) with the labels of these stretches exchanged again."""
    repaired = seen.clone()
    for swap in swaps:
        stretch, pair = slice(swap.first, swap.last), list(swap.markers)
        repaired[stretch, pair] = repaired[stretch, pair[::-1]]
    return repaired


def _stretches(votes: Votes, fits: Mapping[tuple[int, int], Tensor], gap: int) -> list[Swap]:
    """Votes (frame, marker) of pairs joined over at most ``gap`` frames, unless the pair fits (T,) in one of them."""
    swaps = []
    for (a, b), found in votes.items():  # pairs are few: only those with votes
        stretch: list[tuple[int, int]] = []
        for t, voter in [*sorted(found), (len(fits[a, b]) + gap + 1, -1)]:
            if stretch and (t - stretch[-1][0] > gap or bool(fits[a, b][stretch[-1][0] + 1 : t].any())):
                if len({who for _, who in stretch}) == 2 or len(stretch) >= 3:
                    swaps.append(Swap((a, b), stretch[0][0], stretch[-1][0] + 1))
                stretch = []
            stretch.append((t, voter))
    return sorted(swaps, key=lambda swap: (swap.first, swap.markers))


def _centres(markers: Tensor) -> Tensor:
    """Where each marker (T,M,3) is most of the time, (M,3): the mean of the nearer half of its samples, iterated."""
    centre = markers.nanmedian(0).values
    for _ in range(_CENTRE_ITERATIONS):
        distance = (markers - centre).norm(dim=-1, keepdim=True)
        centre = torch.where(distance <= distance.nanmedian(0).values, markers, torch.nan).nanmean(0)
    return centre
