"""Regions of example shapes: the head as a whole, brows, eyes or mouth."""

import re
from collections.abc import Sequence

import torch
from torch import Tensor

REGION_LANDMARKS: dict[str, tuple[int, ...]] = {
    "brows": tuple(range(17, 27)),
    "eyes": tuple(range(36, 48)),
    "mouth": (*range(17), *range(48, 68)),
}
"""The landmarks of each region of expressions: the jaw goes with the mouth."""

HEAD = "head"
"""The region of shapes that turn or tilt the head."""

HEAD_LANDMARKS: tuple[int, ...] = (*range(27, 36), 36, 39, 42, 45)
"""Nose and corners of the eyes: what expressions move least."""

_HEAD_NAME = re.compile(r"(head|rotat|tilt)", re.IGNORECASE)


def shape_regions(names: Sequence[str], basis: Tensor) -> tuple[str, ...]:
    """The region of each of N shapes: the head by its name, the others by where ``basis`` (68,2,N) moves landmarks
    most."""
    squared = basis.detach().square().sum(1)
    moves = torch.stack([squared[list(rows)].sum(0) for rows in REGION_LANDMARKS.values()])
    regions = tuple(REGION_LANDMARKS)
    strongest = [regions[row] for row in moves.argmax(0).tolist()]
    return tuple(HEAD if _HEAD_NAME.search(name) else region for name, region in zip(names, strongest, strict=True))
