"""Activation of correctives at given weights, and its derivatives."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchface.correctives.corrective_shapes import Corrective, check_definitions
from torchface.errors import NameMismatchError

ROUNDED = 3.2  # four fifths at the middle: as near to a straight rise and fall as a parabola comes


class CorrectiveActivation(nn.Module):
    r"""How far each corrective is on at given weights.

    .. math::
        a_c(w) = \prod_{i \in D_c} w_i
        \quad\text{or}\quad
        a_c(w) = \max\left(0, \min\left(\frac{w_i - l}{p - l}, \frac{r - w_i}{r - p}\right)\right)

    for a combination of the drivers :math:`D_c`, and for an in-between with its peak :math:`p` between its neighbours
    :math:`l` and :math:`r`.
    """

    drivers: Tensor
    pairs: Tensor
    first_pairs: Tensor
    in_betweens: Tensor
    knots: Tensor

    def __init__(self, definitions: Sequence[Corrective], names: Sequence[str]) -> None:
        super().__init__()
        check_definitions(definitions)
        self.definitions = tuple(definitions)
        self.shapes = len(names)
        row = {name: i for i, name in enumerate(names)}
        for definition in definitions:
            if missing := [driver for driver in definition.drivers if driver not in row]:
                raise NameMismatchError(
                    f"corrective {definition.name!r}: driven by {', '.join(map(repr, missing))}, which the rig lacks; "
                    f"its {len(names)} shapes are {', '.join(names[:5])}, ..."
                )
            if definition.name in row:
                raise NameMismatchError(f"corrective {definition.name!r}: found a shape of that name, expected another")
        one = len(names)  # the row of a factor of 1
        most = max((len(definition.drivers) for definition in definitions), default=1)
        padded = [[row[driver] for driver in d.drivers] + [one] * (most - len(d.drivers)) for d in definitions]
        # On the CPU also where a solver is being rebuilt without memory: no state brings these.
        drivers = torch.tensor(padded, dtype=torch.int64, device="cpu").view(-1, most)
        flat = drivers.flatten()
        # Pairs of a corrective and a driver, by driver: row i of the derivative's transpose holds those of shape i.
        pairs = flat.argsort(stable=True)[: int((flat < one).sum())]
        counts = torch.bincount(flat[pairs], minlength=one)
        between = [i for i, definition in enumerate(definitions) if definition.is_in_between]
        knots = _knots([definitions[i] for i in between])
        for name, value in (
            ("drivers", drivers),
            ("pairs", pairs),
            ("first_pairs", counts.cumsum(0) - counts),
            ("in_betweens", torch.tensor(between, dtype=torch.int64, device="cpu")),
            ("knots", torch.tensor(knots, dtype=torch.float64, device="cpu").view(-1, 3)),
        ):
            self.register_buffer(name, value, persistent=False)

    def forward(self, weights: Tensor) -> Tensor:
        """Activations (B,C) at weights (B,N); differentiable."""
        activation = self._factors(weights).prod(-1)
        if not len(self.in_betweens):
            return activation
        w = weights[:, self.drivers[self.in_betweens, 0]]
        return activation.index_copy(1, self.in_betweens, self._along(w, *self.knots.to(weights).T))

    def derivative(self, weights: Tensor) -> Tensor:
        """Derivatives (B,C,K) of the activations by the weights of their K drivers, at a kink those within the box."""
        factors = self._factors(weights).unbind(-1)
        before, after = [torch.ones_like(factors[0])], [torch.ones_like(factors[0])]
        for first, last in zip(factors[:-1], factors[:0:-1], strict=True):  # as many as drivers, eight at most
            before.append(before[-1] * first)
            after.append(after[-1] * last)
        slopes = torch.stack([left * right for left, right in zip(before, reversed(after), strict=True)], -1)
        slopes = slopes.masked_fill(self.drivers == self.shapes, 0.0)
        if not len(self.in_betweens):
            return slopes
        w = weights[:, self.drivers[self.in_betweens, 0]]
        slope = self._slope_along(w, *self.knots.to(weights).T)
        own = torch.nn.functional.pad(slope[..., None], (0, slopes.shape[-1] - 1))
        return slopes.index_copy(1, self.in_betweens, own)

    def jacobian(self, weights: Tensor) -> Tensor:
        """All derivatives, (B,C,N) at weights (B,N); differentiable."""
        return self._dense(self.derivative(weights))

    def _dense(self, derivative: Tensor) -> Tensor:
        padded = derivative.new_zeros(*derivative.shape[:2], self.shapes + 1)
        return padded.scatter_add(2, self.drivers.expand_as(derivative), derivative)[..., : self.shapes]

    def pulled_back(self, derivative: Tensor, matrix: Tensor) -> Tensor:
        r"""The product :math:`(\partial a / \partial w)^\top Z` (B,N,K), by its few numbers that are not zero; Z is
        (C,K) or (B,C,K)."""
        if torch.compiler.is_compiling():  # how many are not zero is for a call to find
            return self._dense(derivative).mT @ matrix
        count, pairs = len(derivative), len(self.pairs)
        values = derivative.flatten(1)[:, self.pairs]
        frames = torch.arange(count, device=matrix.device)[:, None]
        rows = (self.pairs // self.drivers.shape[1]).expand(count, -1)
        if matrix.ndim == 3:
            rows = rows + frames * len(self.definitions)
        # Where a face is at rest in most shapes, most products of the others are 0.
        taken = (values != 0).flatten()
        before = torch.nn.functional.pad(taken.cumsum(0), (1, 0))
        summed = torch.nn.functional.embedding_bag(
            rows.flatten()[taken],
            matrix.flatten(0, -2),
            before[(self.first_pairs + frames * pairs).flatten()],
            mode="sum",
            per_sample_weights=values.flatten()[taken],
        )
        return summed.view(count, self.shapes, matrix.shape[-1])

    def slope(self, derivative: Tensor, by_activation: Tensor) -> Tensor:
        """By the weights, (B,N), what falls by the activations as (B,C); differentiable."""
        by_driver = (derivative * by_activation[..., None]).flatten(1)
        padded = by_driver.new_zeros(by_driver.shape[0], self.shapes + 1)
        return padded.index_add(1, self.drivers.flatten(), by_driver)[:, : self.shapes]

    def _factors(self, weights: Tensor) -> Tensor:
        padded = torch.cat([weights, torch.ones_like(weights[:, :1])], 1)
        return padded[:, self.drivers.flatten()].unflatten(1, self.drivers.shape)

    def _along(self, w: Tensor, left: Tensor, peak: Tensor, right: Tensor) -> Tensor:
        """In-betweens at their drivers' weights, (B,K)."""
        return torch.minimum((w - left) / (peak - left), (right - w) / (right - peak)).clamp(min=0.0)

    def _slope_along(self, w: Tensor, left: Tensor, peak: Tensor, right: Tensor) -> Tensor:
        slope = torch.where(w < peak, 1 / (peak - left), -1 / (right - peak))
        return torch.where((w < left) | (w > right) | ((w == right) & (right < 1)), 0.0, slope)

    def records(self) -> list[dict[str, Any]]:
        """The definitions as plain values; see ``definitions_from_records``."""
        return [definition.record() for definition in self.definitions]

    def expressions(self) -> list[str]:
        """The activations in words that Blender's drivers, Maya and Python know, of drivers' weights w0, w1 …"""
        formulas = [
            "*".join(f"w{place}" for place in range(len(definition.drivers))) for definition in self.definitions
        ]
        for row, (left, peak, right) in zip(self.in_betweens.tolist(), self.knots.tolist(), strict=True):
            rise = f"(w0-{left:.9g})" if left else "w0"
            formulas[row] = f"max(0,min({rise}/{peak - left:.9g},({right:.9g}-w0)/{right - peak:.9g}))"
        return formulas

    def extra_repr(self) -> str:
        return f"{len(self.definitions)} correctives, {len(self.in_betweens)} of them in-betweens"


class RoundedActivation(CorrectiveActivation):
    r"""Activations whose in-betweens are parabolas, :math:`3.2\,(w - l)(r - w)/(r - l)^2` from a neighbour to the next.

    A solve whose in-betweens bend at their peaks may end on the wrong side of one; on these it does not, and what it
    finds is near the answer.
    """

    def __init__(self, activation: CorrectiveActivation) -> None:
        nn.Module.__init__(self)
        self.definitions, self.shapes = activation.definitions, activation.shapes
        for name, value in activation.named_buffers():
            self.register_buffer(name, value, persistent=False)

    def _along(self, w: Tensor, left: Tensor, peak: Tensor, right: Tensor) -> Tensor:
        return (ROUNDED * (w - left) * (right - w) / (right - left).square()).clamp(min=0.0)

    def _slope_along(self, w: Tensor, left: Tensor, peak: Tensor, right: Tensor) -> Tensor:
        slope = ROUNDED * (left + right - 2 * w) / (right - left).square()
        return torch.where((w < left) | (w > right), 0.0, slope)


def _knots(in_betweens: Sequence[Corrective]) -> list[tuple[float, float, float]]:
    """For each in-between the peak before it, its own and the one after, of the same driver."""
    peaks: dict[str, list[float]] = {}
    for definition in in_betweens:
        peaks.setdefault(definition.drivers[0], [0.0, 1.0]).append(definition.peak or 0.0)
    around: dict[tuple[str, float], tuple[float, float, float]] = {}
    for driver, found in peaks.items():
        found.sort()
        for low, peak, high in zip(found[:-2], found[1:-1], found[2:], strict=True):
            around[driver, peak] = low, peak, high
    return [around[definition.drivers[0], definition.peak or 0.0] for definition in in_betweens]
