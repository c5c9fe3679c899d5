"""People to take pictures of: a head of some kind, its looks, and its lids, which meet when they are to be closed."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.shape_names import ARKIT

from .head_kind import DrawnHead, HeadKind
from .looks import Looks, draw_looks

_CLOSED = 0.3  # millimetres between lids that are closed
_LID_PAIRS = ((37, 41), (38, 40), (43, 47), (44, 46))


@dataclass(frozen=True, eq=False)
class Person:
    """Someone: head and looks."""

    kind: HeadKind
    head: DrawnHead
    looks: Looks


def draw_person(kinds: Sequence[HeadKind], shares: Sequence[float], generator: torch.Generator) -> Person:
    """Someone of a kind that is drawn as often as its share says."""
    kind = kinds[int(torch.multinomial(torch.tensor(list(shares)), 1, generator=generator))]
    return Person(kind, kind.draw(generator), draw_looks(generator))


def closed_lids(kind: HeadKind, head: DrawnHead, weights: Tensor) -> Tensor:
    """The head (V,3) at ARKit's weights (52,); lids that are to be closed meet on this head too."""
    own = kind.shapes @ weights
    posed = head.posed(own)
    for side, pairs in (("Right", _LID_PAIRS[:2]), ("Left", _LID_PAIRS[2:])):
        row = kind.shapes[:, ARKIT.index(f"eyeBlink{side}")].argmax()
        wanted = float(own[row])
        if wanted < 0.05:
            continue
        ids = kind.landmarks[torch.tensor(pairs)]
        gap = float((posed[ids[:, 0]] - posed[ids[:, 1]])[:, 1].mean())
        unit = float((head.deltas[row, ids[:, 0]] - head.deltas[row, ids[:, 1]])[:, 1].mean())
        opened = gap - wanted * unit
        if unit < -1 and opened > 1:  # a weight of 1 closes
            full = min(max((_CLOSED - opened) / unit, 0.6), 1.35)
            posed = posed + wanted * (full - 1.0) * head.deltas[row]
    return posed
