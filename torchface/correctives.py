"""Correctives of a blendshape rig: what is added where shapes act together, or half-way along one of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.number_checks import checked_number

MOST_DRIVERS = 3
"""A combination shape is driven by two shapes or by three."""

ROUNDED = 3.2  # four fifths at the middle: as near to a straight rise and fall as a parabola comes


@dataclass(frozen=True)
class Corrective:
    """When a corrective acts: at a combination of shapes, or in between the rest and the full weight of one.

    Args:
        name: as no other corrective and no shape of the rig is called.
        drivers: names of shapes: two or three of a combination, whose weights are multiplied; one of an in-between.
        peak: of an in-between, the driver's weight at which it is fully on, between 0 and 1.

    Raises:
        NameMismatchError: no driver, more than three, or one twice.
        ValueRangeError: an in-between whose peak is not between 0 and 1, or a combination with a peak.

    Example:
        >>> Corrective("smile_pucker", ("mouthSmileLeft", "mouthPucker"))
        Corrective(name='smile_pucker', drivers=('mouthSmileLeft', 'mouthPucker'), peak=None)
        >>> Corrective("blink_half", ("eyeBlinkLeft",), peak=0.5).is_in_between
        True
    """

    name: str
    drivers: tuple[str, ...]
    peak: float | None = None

    def __post_init__(self) -> None:
        place = f"corrective {self.name!r:.60}"
        if not isinstance(self.name, str) or not self.name:
            raise NameMismatchError(f"{place}: expected a name")
        if isinstance(self.drivers, str) or not all(isinstance(driver, str) for driver in self.drivers):
            raise NameMismatchError(f"{place}: found drivers {self.drivers!r:.80}, expected a list of shape names")
        object.__setattr__(self, "drivers", tuple(self.drivers))
        count = len(self.drivers)
        if not 1 <= count <= MOST_DRIVERS:
            raise NameMismatchError(
                f"{place}: found a product of {count} shapes, expected two or three, or one and a peak"
            )
        if len(set(self.drivers)) < count:
            raise NameMismatchError(f"{place}: found a driver twice in {', '.join(self.drivers)}; expected each once")
        if count > 1 and self.peak is not None:
            raise ValueRangeError(
                f"{place}: found peak {self.peak} for {count} drivers, expected none: it is a product"
            )
        if count == 1:
            peak = checked_number(f"{place}: peak", self.peak, 0.0, 1.0, above=True)
            if peak == 1.0:
                raise ValueRangeError(f"{place}: peak: found 1, expected less: at 1 it is a shape of its own")
            object.__setattr__(self, "peak", peak)

    @property
    def is_in_between(self) -> bool:
        """Whether one shape alone drives it."""
        return self.peak is not None

    def record(self) -> dict[str, Any]:
        """As plain values, for files; see ``definitions_from_records``."""
        found: dict[str, Any] = {"name": self.name, "drivers": list(self.drivers)}
        return found if self.peak is None else found | {"peak": self.peak}


@dataclass(frozen=True, eq=False)
class Correctives:
    r"""The correctives of a rig: what each adds to the sum of the weighted shapes, times its activation.

    A combination's activation is the product of its drivers' weights. An in-between's rises from 0 at the peak before
    it (or at 0) to 1 at its own, and falls to 0 at the next (or at 1), so that samples along a shape are joined by
    straight lines, as in USD.

    Args:
        deltas: (C,V,3), millimetres: the sculpted pose less what the rig shows there without the corrective.
        definitions: when each acts, C of them.

    Raises:
        ShapeError: ``deltas`` is not (C,V,3) for as many definitions, or there are none.
        NameMismatchError: a name twice, two that act at the same combination or peak, or a corrective that is driven by
            another or, in a cycle, by itself.
        ValueRangeError: a delta is NaN or infinite.

    Example:
        >>> from torchface import BlendshapeRig
        >>> face, still = (torch.eye(3), torch.tensor([[0, 1, 2]])), torch.zeros(2, 3, 3)
        >>> both = Correctives(torch.ones(1, 3, 3), (Corrective("ab", ("a", "b")),))
        >>> rig = BlendshapeRig.from_tensors(*face, still, ["a", "b"], both)
        >>> rig(torch.tensor([[1.0, 0.5]]))[0, 0].tolist()
        [1.5, 0.5, 0.5]
    """

    deltas: Tensor
    definitions: tuple[Corrective, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "definitions", tuple(self.definitions))
        check_definitions(self.definitions)
        if self.deltas.ndim != 3 or self.deltas.shape[2] != 3 or len(self.deltas) != len(self.definitions):
            raise ShapeError(
                f"correctives: found deltas {tuple(self.deltas.shape)} for {len(self.definitions)} definitions, "
                "expected (C,V,3), one each"
            )
        if not len(self.definitions):
            raise ShapeError("correctives: found none, expected at least one; a rig without takes correctives=None")
        finite = torch.isfinite(self.deltas).flatten(1).all(1).tolist()
        if not all(finite):
            bad = [name for name, fine in zip(self.names, finite, strict=True) if not fine]
            raise ValueRangeError(f"correctives: NaN or infinite in {', '.join(bad[:5])}; expected finite millimetres")

    @property
    def names(self) -> tuple[str, ...]:
        """One a corrective."""
        return tuple(definition.name for definition in self.definitions)

    def with_deltas(self, deltas: Tensor) -> Correctives:
        """The same correctives of another face or of other vertices, (C,V,3)."""
        return replace(self, deltas=deltas)

    def select(self, shapes: Sequence[str]) -> Correctives | None:
        """Those whose drivers are all among these shapes, as the others stay at 0 without them; none where none is."""
        kept = set(shapes)
        rows = [i for i, definition in enumerate(self.definitions) if kept.issuperset(definition.drivers)]
        if not rows:
            return None
        return Correctives(self.deltas[rows], tuple(self.definitions[i] for i in rows))


def check_definitions(definitions: Sequence[Corrective]) -> None:
    """Raises ``NameMismatchError`` for what occurs twice, and for correctives that correctives drive."""
    by_name = {definition.name: definition for definition in definitions}
    if len(by_name) < len(definitions):
        counts = Counter(definition.name for definition in definitions)
        twice = sorted(name for name, count in counts.items() if count > 1)
        raise NameMismatchError(f"correctives: found names more than once: {', '.join(twice[:5])}")
    acts: dict[tuple[frozenset[str], float | None], str] = {}
    for definition in definitions:
        when = (frozenset(definition.drivers), definition.peak)
        if when in acts:
            raise NameMismatchError(
                f"correctives: found {acts[when]!r} and {definition.name!r} driven by the same "
                f"{' x '.join(definition.drivers)}{'' if definition.peak is None else f' at {definition.peak:g}'}; "
                "expected one: add their deltas"
            )
        acts[when] = definition.name
    for definition in definitions:
        chain = {definition.name: None}  # an ordered set
        last = definition.name
        while (following := next((d for d in by_name[last].drivers if d in by_name), None)) is not None:
            if following in chain:
                cycle = list(chain)[list(chain).index(following) :]
                shown = " -> ".join([*cycle[:5], following] if len(cycle) <= 5 else [*cycle[:5], "..."])
                raise NameMismatchError(f"correctives: found a cycle, {shown}; expected drivers that are shapes")
            chain[following] = None
            last = following
        if len(chain) > 1:
            first, second = list(chain)[:2]
            raise NameMismatchError(
                f"correctives: {first!r} is driven by the corrective {second!r}, expected shapes of the rig: name "
                "the shapes that drive that one"
            )


def definitions_from_records(records: object) -> tuple[Corrective, ...]:
    """The definitions of plain values from a file, such as ``Corrective.record`` gives.

    Raises:
        NameMismatchError, ValueRangeError: no such values, or of what no rig can have.
    """
    if not isinstance(records, list):
        raise NameMismatchError(f"correctives: found {records!r:.80}, expected a list")
    found = []
    for i, record in enumerate(records):
        given = record if isinstance(record, dict) else {}
        name, drivers, peak = given.get("name"), given.get("drivers"), given.get("peak")
        plain = isinstance(name, str) and isinstance(drivers, list) and all(isinstance(d, str) for d in drivers)
        if not plain or not (peak is None or (isinstance(peak, int | float) and not isinstance(peak, bool))):
            raise NameMismatchError(
                f"correctives[{i}]: found {record!r:.80}, expected a name, a list of drivers' names, and of an "
                "in-between a peak"
            )
        found.append(Corrective(str(name), tuple(drivers or ()), peak))
    check_definitions(found)
    return tuple(found)


class CorrectiveActivation(nn.Module):
    r"""How far each corrective is on at given weights.

    .. math::
        a_c(w) = \prod_{i \in D_c} w_i
        \quad\text{or}\quad
        a_c(w) = \max\left(0, \min\left(\frac{w_i - l}{p - l}, \frac{r - w_i}{r - p}\right)\right)

    for a combination of the drivers :math:`D_c`, and for an in-between with its peak :math:`p` between its neighbours
    :math:`l` and :math:`r`.

    Args:
        definitions: C correctives.
        names: of the N shapes.

    Raises:
        NameMismatchError: a driver is no shape, or a corrective has a shape's name.

    Example:
        >>> both = CorrectiveActivation([Corrective("ab", ("a", "b")), Corrective("a50", ("a",), 0.5)], ["a", "b"])
        >>> both(torch.tensor([[0.5, 1.0], [0.75, 0.0]])).tolist()
        [[0.5, 1.0], [0.0, 0.5]]
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
        padded = [[row[driver] for driver in d.drivers] + [one] * (MOST_DRIVERS - len(d.drivers)) for d in definitions]
        # On the CPU also where a solver is being rebuilt without memory: no state brings these.
        drivers = torch.tensor(padded, dtype=torch.int64, device="cpu").view(-1, MOST_DRIVERS)
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
        """Derivatives (B,C,3) of the activations by the weights of their drivers, at a kink those within the box."""
        factors = self._factors(weights)
        first, second, third = factors.split(1, -1)
        slopes = torch.cat([second * third, first * third, first * second], -1)
        slopes = slopes.masked_fill(self.drivers == self.shapes, 0.0)
        if not len(self.in_betweens):
            return slopes
        w = weights[:, self.drivers[self.in_betweens, 0]]
        slope = self._slope_along(w, *self.knots.to(weights).T)
        none = torch.zeros_like(slope)
        return slopes.index_copy(1, self.in_betweens, torch.stack([slope, none, none], -1))

    def jacobian(self, weights: Tensor) -> Tensor:
        """All derivatives, (B,C,N) at weights (B,N); differentiable."""
        derivative = self.derivative(weights)
        found = derivative.new_zeros(*derivative.shape[:2], self.shapes + 1)
        return found.scatter_add(2, self.drivers.expand_as(derivative), derivative)[..., : self.shapes]

    def pulled_back(self, derivative: Tensor, matrix: Tensor) -> Tensor:
        r"""The product :math:`(\partial a / \partial w)^\top Z` (B,N,K), by its few numbers that are not zero.

        Args:
            derivative: (B,C,3), as :meth:`derivative` gives it.
            matrix: :math:`Z`, (C,K) for all frames or (B,C,K).
        """
        count, pairs = len(derivative), len(self.pairs)
        values = derivative.flatten(1)[:, self.pairs]
        frames = torch.arange(count, device=matrix.device)[:, None]
        rows = (self.pairs // MOST_DRIVERS).expand(count, -1)
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
        return summed.view(count, self.shapes, -1)

    def slope(self, derivative: Tensor, by_activation: Tensor) -> Tensor:
        """By the weights, (B,N), what falls by the activations as (B,C); differentiable."""
        by_driver = (derivative * by_activation[..., None]).flatten(1)
        found = by_driver.new_zeros(len(by_driver), self.shapes + 1)
        return found.index_add(1, self.drivers.flatten(), by_driver)[:, : self.shapes]

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
        """The activations in words that Blender's drivers, Maya and Python know, of the drivers' weights w0, w1, w2.

        Example:
            >>> CorrectiveActivation([Corrective("ab", ("a", "b")), Corrective("a4", ("a",), 0.4)], "ab").expressions()
            ['w0*w1', 'max(0,min(w0/0.4,(1-w0)/0.6))']
        """
        found = ["*".join(f"w{place}" for place in range(len(one.drivers))) for one in self.definitions]
        for row, (left, peak, right) in zip(self.in_betweens.tolist(), self.knots.tolist(), strict=True):
            rise = f"(w0-{left:.9g})" if left else "w0"
            found[row] = f"max(0,min({rise}/{peak - left:.9g},({right:.9g}-w0)/{right - peak:.9g}))"
        return found

    def extra_repr(self) -> str:
        return f"{len(self.definitions)} correctives, {len(self.in_betweens)} of them in-betweens"


class RoundedActivation(CorrectiveActivation):
    r"""Activations whose in-betweens are parabolas, :math:`3.2\,(w - l)(r - w)/(r - l)^2` from a neighbour to the next.

    A solve whose in-betweens bend at their peaks may end on the wrong side of one; on these it does not, and what it
    finds is near the answer.

    Args:
        activation: C correctives.
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


def merged_correctives(correctives: Correctives, renamed: Mapping[str, str]) -> Correctives:
    """Correctives of a rig in which shapes were renamed, and some of them summed under one name.

    What comes to act at the same combination is summed. In-betweens of summed shapes keep every peak of either: at each
    the sum of what all of them showed there.

    Args:
        correctives: of the rig before.
        renamed: for each shape what it is called afterwards; a shape that is not in it keeps its name.

    Raises:
        NameMismatchError: two drivers of one combination became one shape.
    """
    groups: dict[tuple[str, ...], list[int]] = {}
    for row, definition in enumerate(correctives.definitions):
        drivers = tuple(sorted(renamed.get(driver, driver) for driver in definition.drivers))
        if len(set(drivers)) < len(drivers):
            raise NameMismatchError(
                f"corrective {definition.name!r}: driven by {' x '.join(definition.drivers)}, which become one shape, "
                f"{Counter(drivers).most_common(1)[0][0]!r}; expected drivers that stay apart: take the corrective out"
            )
        groups.setdefault(drivers, []).append(row)
    definitions, deltas = [], []
    for drivers, rows in groups.items():
        first = correctives.definitions[rows[0]]
        if not first.is_in_between:
            kept = tuple(dict.fromkeys(renamed.get(driver, driver) for driver in first.drivers))
            definitions.append(replace(first, drivers=kept))
            deltas.append(correctives.deltas[rows].sum(0))
            continue
        own = [correctives.definitions[row] for row in rows]
        before = tuple(dict.fromkeys(definition.drivers[0] for definition in own))
        names = {definition.peak: definition.name for definition in reversed(own)}
        peaks = sorted(names, key=lambda peak: peak or 0.0)
        at_peaks = torch.tensor(peaks, dtype=torch.float64)[:, None].expand(-1, len(before))
        shares = CorrectiveActivation(own, before)(at_peaks).to(correctives.deltas)
        definitions += [Corrective(names[peak], drivers, peak) for peak in peaks]
        deltas += torch.einsum("pc,cvk->pvk", shares, correctives.deltas[rows]).unbind()
    return Correctives(torch.stack(deltas), tuple(definitions))
