"""A folder of expression scans: which file shows what."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.io.tables.csv_table import TableReader
from torchface.shape_names import mapping
from torchface.workflows.batch.batch_items import SCAN_ENDINGS

WEIGHTS = "weights.csv"
NEUTRAL = "neutral"
LAYOUT = (
    f"a {WEIGHTS} with the header scan,<shape>,... and a row for each file, or files named for what they show: "
    "jawOpen.obj, jawOpen=0.6+mouthSmileLeft=0.5.obj"
)


@dataclass(frozen=True, eq=False)
class Expression:
    """A scan and roughly what it shows: weights (N,) of a rig's shapes, in [0,1]."""

    path: Path
    weights: Tensor

    @property
    def name(self) -> str:
        """The file's name without its ending."""
        return self.path.stem


def weights_row(weights: dict[str, float], names: Sequence[str], where: str) -> Tensor:
    """Weights (N,) of a rig's shapes from some of them by name, in any spelling that ``shape_names`` reads.

    Raises:
        NameMismatchError: a name that means no shape of the rig.
        ValueRangeError: a weight outside [0,1].
    """
    given = tuple(weights)
    matrix = mapping(given, names)
    unknown = [name for name, used in zip(given, matrix.any(0).tolist(), strict=True) if not used]
    if unknown:
        raise NameMismatchError(
            f"{where}: found {', '.join(map(repr, unknown[:5]))}, expected shapes of the template such as "
            f"{', '.join(names[:5])}"
        )
    outside = [f"{name}={value:g}" for name, value in weights.items() if not 0 <= value <= 1]
    if outside:
        raise ValueRangeError(f"{where}: found {', '.join(outside[:5])}, expected weights from 0 to 1")
    return matrix @ torch.tensor([float(weights[name]) for name in given])


def expressions_in(folder: Path, names: Sequence[str]) -> list[Expression]:
    """The expression scans of a folder, in the order of ``weights.csv``, or sorted by name.

    Without ``weights.csv`` each file's name gives what it shows: shapes joined by ``+``, each with ``=WEIGHT`` where
    that is not 1. A file named ``neutral`` is left out.

    Args:
        folder: scans, and ``weights.csv`` where the names do not give it.
        names: the rig's shapes.

    Raises:
        FileFormatError: no such folder, a table without the column ``scan`` or with two rows for a file, or a file
            that it names and that is not there.
        NameMismatchError: a name that means no shape of the rig.
        ValueRangeError: a weight outside [0,1], or an expression without any.
    """
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: found no such folder, expected one with scans: {LAYOUT}")
    table = folder / WEIGHTS
    found = _by_table(table, names) if table.is_file() else _by_name(folder, names)
    for expression in found:
        if not expression.weights.any():
            raise ValueRangeError(f"{expression.path}: found no weight above 0 for it, expected an expression")
    return found


def neutral_in(folder: Path) -> Path | None:
    """The folder's scan of the face at rest: the file named ``neutral``, where there is one."""
    return next((path for path in _scans(folder) if path.stem.lower() == NEUTRAL), None)


def _scans(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SCAN_ENDINGS and path.is_file())


def _by_table(table: Path, names: Sequence[str]) -> list[Expression]:
    reader = TableReader(table)
    reader.require(["scan"])
    rows = reader.read(["scan"], lambda cells: not any(cell.strip() for cell in cells))
    shapes = rows.names
    files = list(rows.texts["scan"])
    twice = sorted({file for file in files if files.count(file) > 1})
    if twice:
        raise FileFormatError(f"{table}: found more than one row for {', '.join(twice[:5])}, expected one a scan")
    found = []
    for number, file in enumerate(files):
        path = table.parent / file
        if Path(file).name != file or not path.is_file():
            raise FileFormatError(f"{table}: found {file!r} in the column scan, expected a file of the same folder")
        values = torch.from_numpy(rows.numbers[number]).nan_to_num().tolist()
        given = {shape: value for shape, value in zip(shapes, values, strict=True) if value != 0}
        row = weights_row(given, names, f"{table}: {file}") if given else torch.zeros(len(names))
        found.append(Expression(path, row))
    return found


def _by_name(folder: Path, names: Sequence[str]) -> list[Expression]:
    found = []
    for path in _scans(folder):
        if path.stem.lower() == NEUTRAL:
            continue
        given: dict[str, float] = {}
        for word in path.stem.split("+"):
            name, equals, number = word.partition("=")
            if name.strip() in given:
                raise ValueRangeError(f"{path}: found {name.strip()!r} twice in its name, expected each shape once")
            try:
                given[name.strip()] = float(number) if equals else 1.0
            except ValueError:
                raise ValueRangeError(f"{path}: found {word!r} in its name, expected SHAPE=WEIGHT; {LAYOUT}") from None
        try:
            found.append(Expression(path, weights_row(given, names, str(path))))
        except NameMismatchError as error:
            raise NameMismatchError(f"{error}; either {LAYOUT}") from None
    return found
