"""Basis of a thousand frames' details: few components in half precision, learned a block at a time."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError

_SAMPLED_SITES = 20_000
_CHUNK = 2**15  # numbers of a component that are worked on at a time
_NUMBERS = 2**28  # that a basis has at most while it is learned, where twice its rank would be more
_NEGLIGIBLE = 1e-12  # of a block's energy


class StreamingBasis:
    r"""The best components of rows that come a block at a time, and every row's coefficients in them.

    Keeps twice as many components as are asked for, so that what is dropped on the way is next to nothing. Rows are
    not centred: a row of zeros has coefficients of zero.

    Args:
        size: n, numbers a row.
        rank: r, how many components are wanted.

    Source: Brand 2006, Fast low-rank modifications of the thin singular value decomposition, for blocks.
    """

    def __init__(self, size: int, rank: int) -> None:
        self.rank = rank
        self._kept = min(2 * rank, max(rank, _NUMBERS // size))
        self._basis = torch.zeros(0, size, dtype=torch.float32)
        self._coefficients = torch.zeros(0, 0, dtype=torch.float64)
        self._total = torch.zeros((), dtype=torch.float64)
        self._dropped = torch.zeros((), dtype=torch.float64)

    @property
    def state(self) -> dict[str, Tensor]:
        """Everything it has learned so far."""
        return {
            "basis": self._basis,
            "coefficients": self._coefficients,
            "total": self._total,
            "dropped": self._dropped,
        }

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Goes on where another one was."""
        self._basis, self._coefficients = state["basis"], state["coefficients"]
        self._total, self._dropped = state["total"], state["dropped"]

    def add(self, rows: Tensor) -> None:
        """Learns from more rows, (B,n) float32, whose memory it uses."""
        if rows.ndim != 2 or rows.shape[1] != self._basis.shape[1]:
            raise ShapeError(f"rows: found {tuple(rows.shape)}, expected (B,{self._basis.shape[1]})")
        energy = rows.square().sum(dtype=torch.float64)
        inside = rows @ self._basis.T
        rest = rows.addmm_(inside, self._basis, alpha=-1)
        again = rest @ self._basis.T  # once more: rounding leaves a part that is not orthogonal
        rest.addmm_(again, self._basis, alpha=-1)
        values, vectors = torch.linalg.eigh((rest @ rest.T).double())
        new = values > _NEGLIGIBLE * float(energy)
        roots = values[new].sqrt()
        own = vectors[:, new] * roots
        old = len(self._basis)
        known = self._coefficients
        stacked = torch.zeros(len(known) + len(rows), old + len(roots), dtype=torch.float64)
        stacked[: len(known), :old] = known
        stacked[len(known) :, :old] = (inside + again).double()
        stacked[len(known) :, old:] = own
        held, turned = torch.linalg.eigh(stacked.T @ stacked)
        self._total = self._total + energy
        self._dropped = self._dropped + held[: -self._kept].clamp(min=0).sum()
        turned = turned[:, -self._kept :].flip(1)
        lift = (vectors[:, new] / roots).T.float()
        to_old, to_new = turned[:old].T.float(), turned[old:].T.float() @ lift
        # Into its own memory once it has its full size: at 500,000 vertices it is most of what there is.
        basis = self._basis if turned.shape[1] == old else rows.new_empty(turned.shape[1], rows.shape[1])
        for begin in range(0, rows.shape[1], _CHUNK):
            some = slice(begin, begin + _CHUNK)
            basis[:, some] = to_old @ self._basis[:, some] + to_new @ rest[:, some]
        self._basis, self._coefficients = basis, stacked @ turned

    def finished(self) -> "LearnedBasis":
        """The components of the rows so far."""
        count = min(self.rank, len(self._basis))
        # Entries near 1, not near 1 / sqrt(n), which half precision would not hold to its full digits.
        unit = self._basis.shape[1] ** 0.5
        coefficients = self._coefficients[:, :count]
        lost = float(self._dropped + self._coefficients[:, count:].square().sum())
        components = (self._basis[:count] * unit).half()
        share = lost / float(self._total) if float(self._total) > 0 else 0.0
        return LearnedBasis(components, (coefficients / unit).float(), min(1.0, share))


@dataclass(frozen=True, eq=False)
class LearnedBasis:
    """Components and coefficients of what was learned."""

    components: Tensor  # (r,n), half precision, root mean square 1 each
    coefficients: Tensor  # of every row, (K,r), in the rows' unit
    lost_share: float  # of the rows' energy, by what the components do not hold


def blended(components: Tensor, coefficients: Tensor, weights: Tensor) -> Tensor:
    r"""Rows (T,n) of several regions, blended where their borders are soft; differentiable in the coefficients.

    .. math:: b_{tcs} = \sum_r \omega_{rs} \sum_k c_{trk} \, U_{kcs}

    Args:
        components: U, (k,n) in half precision or any, n = C·S: channels, then sites.
        coefficients: c, (T,R,k).
        weights: of the regions at every site, (R,S), of sum 1.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, equation 4.
    """
    frames, regions, rank = coefficients.shape
    sites = weights.shape[1]
    channels = components.shape[1] // sites
    flat = coefficients.flatten(0, 1)
    pieces = []
    step = max(1, _CHUNK // max(1, frames))
    planes = components.view(rank, channels, sites)
    for begin in range(0, sites, step):
        own = weights[:, begin : begin + step].to(coefficients)
        some = planes[:, :, begin : begin + step].to(coefficients.dtype).flatten(1)
        rows = (flat @ some).view(frames, regions, channels, -1)
        pieces.append((rows * own[None, :, None]).sum(1))
    return torch.cat(pieces, dim=2).flatten(1)


def region_products(components: Tensor, weights: Tensor) -> Tensor:
    """Inner products of components, see :func:`blended`, over each region, (R,k,k), float64, of every so many sites."""
    sites = weights.shape[1]
    some = slice(None, None, max(1, sites // _SAMPLED_SITES))
    planes = components.view(len(components), -1, sites)[..., some].double()
    return torch.stack([(planes * own).flatten(1) @ planes.flatten(1).T for own in weights[:, some].double()])
