"""Frames of real clips that a person has coded by eye, ``coded_frames.csv``, and what weights say of the same.

A cell is empty where the eye does not say yes or no at once. No frame plainly shows knit brows or eyes turned aside.
"""

import csv
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from torchface.shape_names import ARKIT

TABLE = Path(__file__).with_name("coded_frames.csv")


def _mean(*names: str) -> Callable[[Tensor], Tensor]:
    rows = [row for row, shape in enumerate(ARKIT) if shape.startswith(names)]
    return lambda weights: weights[:, rows].mean(1)


def _apart(weights: Tensor) -> Tensor:
    jaw, closed = (weights[:, ARKIT.index(name)] for name in ("jawOpen", "mouthClose"))
    return (jaw - closed).clamp(min=0) + _mean("mouthLowerDown", "mouthUpperUp")(weights)


ATTRIBUTES: dict[str, tuple[str, Callable[[Tensor], Tensor], float]] = {
    "shut": ("eyes shut", _mean("eyeBlink"), 0.5),
    "apart": ("lips apart", _apart, 0.15),
    "smile": ("smile", _mean("mouthSmile"), 0.25),
    "brows_up": ("brows up", _mean("browInnerUp", "browOuterUp"), 0.25),
}
"""Columns of the table: their names, a number of weights (T,52), and from where on that is a yes."""


def coded() -> dict[str, dict[str, dict[int, bool]]]:
    """Yes or no by film, attribute and frame."""
    found: dict[str, dict[str, dict[int, bool]]] = {}
    with TABLE.open(newline="") as opened:
        for row in csv.DictReader(opened):
            for name in ATTRIBUTES:
                if row[name]:
                    film = found.setdefault(row["film"], {})
                    film.setdefault(name, {})[int(row["frame"])] = row[name] == "yes"
    return found


def agreement(weights: dict[str, Tensor]) -> dict[str, tuple[int, int, int, int]]:
    """How weights (T,52) of films agree with the coding, by attribute.

    Returns:
        Frames that are a yes and said to be one, frames that are a yes; frames that are a no and said to be one, frames
        that are a no.
    """
    counts = {}
    for name, (_, number, least) in ATTRIBUTES.items():
        told, true = [], []
        for film, parts in coded().items():
            said = number(weights[film].nan_to_num(0.0)) > least
            for frame, yes in parts.get(name, {}).items():
                told.append(bool(said[frame]))
                true.append(yes)
        a, b = torch.tensor(told), torch.tensor(true)
        counts[name] = (int((a & b).sum()), int(b.sum()), int((~a & ~b).sum()), int((~b).sum()))
    return counts
