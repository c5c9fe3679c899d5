"""Action units as weights of a rig's shapes: a table a rig, in TOML."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ValueRangeError
from torchface.files.documents import read_toml, write_toml

_FORMAT = "torchface.action_unit_shapes/1"
_BUILT_IN = Path(__file__).with_name("tables")


@dataclass(frozen=True)
class ShapeTable:
    """Weights of shapes at full intensity of an action unit.

    Args:
        units: weight by shape name, by unit.

    Raises:
        ValueRangeError: a weight is not in (0,1].
        NameMismatchError: there is no unit, or a unit without a shape.

    Example:
        >>> table = ShapeTable({"4": {"frown": 0.7}})
        >>> table.matrix(["4"], ["jawOpen", "frown"]).round(decimals=3).tolist() == torch.tensor([[0.0, 0.7]]).tolist()
        True
    """

    units: dict[str, dict[str, float]]

    def __post_init__(self) -> None:
        empty = [unit for unit, shapes in self.units.items() if not shapes]
        if empty or not self.units:
            raise NameMismatchError(f"shape table: found no shapes for {', '.join(empty) or 'any unit'}, expected some")
        for unit, shapes in self.units.items():
            for shape, weight in shapes.items():
                if not 0 < weight <= 1:
                    raise ValueRangeError(f"shape table: {unit} moves {shape} by {weight}, expected a weight in (0,1]")

    def matrix(self, units: Sequence[str], names: Sequence[str]) -> Tensor:
        """Weights (A,N) of a rig's shapes.

        Args:
            units: the classifier's, A; one that the table lacks moves nothing.
            names: of the rig's shapes, N.

        Raises:
            NameMismatchError: the rig lacks a shape that a unit moves.
        """
        wanted = {shape for unit in units for shape in self.units.get(unit, {})}
        lacking = sorted(wanted - set(names))
        if lacking:
            raise NameMismatchError(
                f"shape table: found the shapes {', '.join(lacking[:5])}, expected names of the rig: "
                f"{', '.join(list(names)[:5])}, ...; write a table for this rig"
            )
        matrix = torch.zeros(len(units), len(names))
        for a, unit in enumerate(units):
            for shape, weight in self.units.get(unit, {}).items():
                matrix[a, list(names).index(shape)] = weight
        return matrix

    def save(self, path: str | Path) -> None:
        """Writes TOML; the file appears only when it is complete."""
        write_toml(path, {"format": _FORMAT, "units": self.units})


def built_in_tables() -> list[str]:
    """Names of the tables that come with torchface."""
    return sorted(path.stem for path in _BUILT_IN.glob("*.toml"))


def load_shape_table(name_or_path: str | Path) -> ShapeTable:
    """A table by name (``arkit``, ``ict``) or from a file of one's own.

    Raises:
        NameMismatchError: no such name.
        FileFormatError: the file cannot be read, or is no table.
        ValueRangeError: a weight is not in (0,1].

    Example:
        >>> sorted(load_shape_table("arkit").units["4"])  # the brow lowerer
        ['browDownLeft', 'browDownRight']
    """
    path = Path(name_or_path)
    if not isinstance(name_or_path, Path) and path.suffix == "" and path.name == str(name_or_path):
        if path.name not in built_in_tables():
            raise NameMismatchError(
                f"shape table: found no {path.name!r}, expected {', '.join(built_in_tables())}, or a .toml file"
            )
        path = _BUILT_IN / f"{path.name}.toml"
    units = {unit: shapes.table() for unit, shapes in read_toml(path, _FORMAT)["units"].table().items()}
    weights = {
        unit: {name: weight.number("a weight for each shape") for name, weight in shapes.items()}
        for unit, shapes in units.items()
    }
    try:
        return ShapeTable(weights)
    except (ValueRangeError, NameMismatchError) as error:
        raise type(error)(f"{path}: {error}") from error
