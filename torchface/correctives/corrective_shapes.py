"""Correctives of a blendshape rig: what is added where shapes act together, or half-way along one of them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchface.errors import ArgumentTypeError, NameMismatchError, ShapeError, ValueRangeError
from torchface.number_checks import as_tensor, checked_number, checked_type

MOST_DRIVERS = 8  # a combination shape is driven by two to eight shapes


@dataclass(frozen=True)
class Corrective:
    """When a corrective acts: at a combination of shapes, or in between the rest and the full weight of one.

    Args:
        name: as no other corrective and no shape of the rig is called.
        drivers: names of shapes: two to eight of a combination, whose weights are multiplied; one of an in-between.
        peak: of an in-between, the driver's weight at which it is fully on, between 0 and 1.

    Raises:
        NameMismatchError: no driver, more than eight, or one twice.
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
                f"{place}: found a product of {count} shapes, expected two to {MOST_DRIVERS}, or one and a peak"
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
        entry: dict[str, Any] = {"name": self.name, "drivers": list(self.drivers)}
        return entry if self.peak is None else entry | {"peak": self.peak}


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
        object.__setattr__(self, "deltas", as_tensor("correctives: deltas", self.deltas, "(C,V,3)"))
        if isinstance(self.definitions, Tensor | Corrective):
            raise ArgumentTypeError("correctives: found no list of definitions, expected a list of Corrective")
        for definition in self.definitions:
            checked_type("correctives: definition", definition, Corrective)
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

    def with_deltas(self, deltas: Tensor) -> "Correctives":
        """The same correctives of another face or of other vertices, (C,V,3)."""
        return replace(self, deltas=deltas)

    def select(self, shapes: Sequence[str]) -> "Correctives | None":
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
    """The definitions of plain values from a file, such as ``Corrective.record`` gives."""
    if not isinstance(records, list):
        raise NameMismatchError(f"correctives: found {records!r:.80}, expected a list")
    definitions = []
    for i, record in enumerate(records):
        given = record if isinstance(record, dict) else {}
        name, drivers, peak = given.get("name"), given.get("drivers"), given.get("peak")
        plain = isinstance(name, str) and isinstance(drivers, list) and all(isinstance(d, str) for d in drivers)
        if not plain or not (peak is None or (isinstance(peak, int | float) and not isinstance(peak, bool))):
            raise NameMismatchError(
                f"correctives[{i}]: found {record!r:.80}, expected a name, a list of drivers' names, and of an "
                "in-between a peak"
            )
        definitions.append(Corrective(str(name), tuple(drivers or ()), peak))
    check_definitions(definitions)
    return tuple(definitions)
