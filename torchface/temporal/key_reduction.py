"""Keys of a curve: the few of its samples between which straight lines stay within a bound of all the others."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.errors import ShapeError
from torchface.number_checks import checked_number

_WINDOW = 32
_ROUNDING = 1e-6  # of the bound, which numbers in files may add


@dataclass(frozen=True)
class KeyReduction:
    """How many keys were left, and how far curves are from the samples they had."""

    # before, after: keys of all curves; curves that share their times count once
    before: int
    after: int
    largest: float  # distance between a sample and its curve

    def __str__(self) -> str:
        return f"{self.after:,} of {self.before:,} keys, largest error {self.largest:.2g}"


def kept_keys(times: Tensor, values: Tensor, bound: float) -> Tensor:
    r"""The samples that curves need as keys, linear between them, to stay within a bound of all samples.

    .. math:: \left| x_i + \frac{t_k - t_i}{t_j - t_i} (x_j - x_i) - x_k \right| \le \epsilon

    for each sample k between neighbouring keys i and j. From a key on, the next one is the farthest sample that the
    slopes through all between allow, of every curve at once.

    Args:
        times: of the samples, (T,), rising.
        values: of C curves that share their keys, (T,C); samples with a NaN, and those beside them, are keys.
        bound: :math:`\epsilon`, above 0.

    Returns:
        (T,) bool; the first and the last sample are keys.

    Source: Gritzali and Papakonstantinou 1983; Imai and Iri 1988.
    """
    bound = checked_number("bound of keys", bound, 0.0, above=True) * (1 - _ROUNDING)
    if values.ndim != 2 or times.shape != values.shape[:1]:
        raise ShapeError(
            f"keys: found times {tuple(times.shape)} and values {tuple(values.shape)}, expected (T,) (T,C)"
        )
    t, x = times.detach().cpu().double().numpy(), values.detach().cpu().double().numpy()
    kept = np.zeros(len(t), dtype=bool)
    if len(t) == 0:
        return torch.from_numpy(kept)
    missing = np.isnan(x).any(1)
    kept[0] = kept[-1] = True
    kept |= missing
    kept[1:] |= missing[:-1]
    kept[:-1] |= missing[1:]
    stops = np.flatnonzero(kept)
    for start, stop in zip(stops[:-1].tolist(), stops[1:].tolist(), strict=True):
        key = start
        while key < stop - 1:  # each key depends on the one before
            key = _farthest(t[key : stop + 1], x[key : stop + 1], bound) + key
            kept[key] = True
    return torch.from_numpy(kept)


def _farthest(t: NDArray[np.float64], x: NDArray[np.float64], bound: float) -> int:
    """The last sample to which a straight line from the first passes all between within the bound."""
    best, count = 1, min(_WINDOW, len(t) - 1)
    while True:
        steps = (t[1 : count + 1] - t[0])[:, None]
        rise = x[1 : count + 1] - x[0]
        low = np.maximum.accumulate((rise - bound) / steps, axis=0)[:-1]
        high = np.minimum.accumulate((rise + bound) / steps, axis=0)[:-1]
        slope = (rise / steps)[1:]
        reached = np.flatnonzero(((low <= slope) & (slope <= high)).all(1))
        best = int(reached[-1]) + 2 if len(reached) else best
        closed = count > 1 and bool((low[-1] > high[-1]).any())
        if closed or count == len(t) - 1:
            return best
        count = min(2 * count, len(t) - 1)


def reduction_error(times: Tensor, values: Tensor, kept: Tensor) -> float:
    """The largest distance of samples (T,C) from straight lines between those that were kept; a NaN does not count."""
    t, x, rows = times.double().numpy(), values.double().numpy(), kept.numpy()
    lines = [np.abs(np.interp(t, t[rows], column[rows]) - column) for column in x.T]
    return float(np.nanmax(lines, initial=0.0)) if lines else 0.0
