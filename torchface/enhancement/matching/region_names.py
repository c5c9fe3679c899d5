"""Names of regions by where they lie on a face, by its landmarks."""

import torch
from torch import Tensor

_PLACES = {
    "mouth": ((48, 49, 50, 58, 59, 60, 61, 67), (54, 53, 52, 56, 55, 64, 63, 65)),
    "brow": ((17, 18, 19, 20, 21), (26, 25, 24, 23, 22)),
    "nose": ((29, 30, 31, 32), (29, 30, 35, 34)),
    "chin": ((6, 7, 8), (10, 9, 8)),
    "jaw": ((2, 3, 4, 5), (14, 13, 12, 11)),
}
"""Landmarks of each place: of the actor's right side, of the left."""
_BETWEEN = {"cheek": ((36, 48, 2, 31), (45, 54, 14, 35)), "temple": ((36, 36, 17, 0), (45, 45, 26, 16))}
"""Places that no landmark marks, by the mean of some around."""
_VOLUNTARY = ("mouth", "brow")


def named_regions(
    labels: Tensor, count: int, neutral: Tensor, faces: Tensor, landmarks: Tensor | None, eyes: tuple[str, ...]
) -> tuple[tuple[str, ...], Tensor]:
    """The name of each region, and whether an actor moves it at will, (R,) bool.

    A place goes to the region that holds most of its landmarks; a region that holds those of both sides has a name
    without a side. What is left is called by its height: forehead above the brows, else by its number.

    Args:
        labels: the region of each triangle, (F,) int64.
        count: of regions, R.
        neutral: (V,3), millimetres.
        landmarks: vertex ids of the 68 iBUG landmarks; without them all are numbered, and none is voluntary.
    """
    numbered = [f"region_{number:02d}" for number in range(count - len(eyes))]
    names = [*numbered, *eyes]
    voluntary = torch.zeros(count, dtype=torch.bool)
    if landmarks is None:
        return tuple(names), voluntary
    at_vertex = torch.full((len(neutral),), -1).scatter(0, faces.flatten(), labels.repeat_interleave(3))
    free = set(range(len(numbered)))
    for place, sides in (_PLACES | _BETWEEN).items():
        held = [_holder(at_vertex, neutral, landmarks, ids, place in _BETWEEN, free) for ids in sides]
        if held[0] is not None and held[0] == held[1]:
            named = {place: held[0]}
        else:
            named = {f"{place}_{side}": r for side, r in zip(("right", "left"), held, strict=True) if r is not None}
        for name, region in named.items():
            names[region] = name
            voluntary[region] = place in _VOLUNTARY
            free.discard(region)
    _name_foreheads(names, free, labels, neutral, faces, landmarks)
    return tuple(names), voluntary


def _holder(
    at_vertex: Tensor, neutral: Tensor, landmarks: Tensor, ids: tuple[int, ...], between: bool, free: set[int]
) -> int | None:
    """The nameless region that holds most of some landmarks, or the point between them; None where there is none."""
    vertices = landmarks[list(ids)]
    if between:
        known = (at_vertex >= 0).nonzero()[:, 0]
        middle = neutral[vertices].mean(0)
        vertices = known[(neutral[known] - middle).norm(dim=1).argmin()][None]
    held = [region for region in at_vertex[vertices].tolist() if region in free]
    return max(set(held), key=lambda region: (held.count(region), -region)) if held else None


def _name_foreheads(
    names: list[str], free: set[int], labels: Tensor, neutral: Tensor, faces: Tensor, landmarks: Tensor
) -> None:
    above = float(neutral[landmarks[17:27], 1].mean())
    middles = neutral[faces].mean(1)
    inside = {region: middles[labels == region].mean(0) for region in free}
    high = sorted((region for region, middle in inside.items() if middle[1] > above), key=lambda r: float(inside[r][0]))
    many = len(high) > 1
    for number, region in enumerate(high, start=1):
        names[region] = f"forehead_{number}" if many else "forehead"
