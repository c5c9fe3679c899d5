"""The character that a performer moves: any rig by ARKit's names or by a mapping table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.retargeting import ShapeMap, load_shape_rules, shape_map
from torchface.errors import FileFormatError, NameMismatchError
from torchface.io import load_rig
from torchface.io.tables.csv_table import quoted
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT
from torchface.synthetic import performer

_MAX_BYTES = 200 * 2**20
_FEW = 10
_BLOCK = 4096  # frames mapped at a time


@dataclass(frozen=True, eq=False)
class Character:
    """A rig and what drives it.

    Args:
        name: for people.
        rig: what moves.
        shapes: from ARKit's names to the rig's.
    """

    name: str
    rig: BlendshapeRig
    shapes: ShapeMap

    def weights(self, arkit: Tensor) -> Tensor:
        """ARKit's weights (T,52) as the rig's (T,N)."""
        moved = torch.empty(len(arkit), len(self.rig.names))
        for first in range(0, len(arkit), _BLOCK):  # an hour at once would fill the memory
            rows = slice(first, first + _BLOCK)
            moved[rows] = self.shapes(arkit[rows])
        return moved

    def notes(self) -> tuple[str, ...]:
        """What the user should know of it."""
        driven = len(self.rig.names) - len(self.shapes.undriven)
        if driven >= _FEW or not self.shapes.undriven:
            return ()
        return (
            f"{self.name}: {driven} of its {len(self.rig.names)} shapes move; {quoted(self.shapes.undriven)} are "
            "neither ARKit's nor in a mapping table (--mapping)",
        )


def load_character(path: Path | None = None, table: Path | None = None) -> Character:
    """Reads a character.

    Args:
        path: a ``.glb``, or what else holds a rig; the embedded performer if absent.
        table: for shapes of other names than ARKit's; see :func:`torchface.capture.retargeting.load_shape_rules`.
    """
    if path is None:
        name, rig = "the embedded performer", performer()
    else:
        if path.is_file() and path.stat().st_size > _MAX_BYTES:
            raise FileFormatError(
                f"{path}: found {path.stat().st_size / 2**20:.0f} MB, expected at most {_MAX_BYTES / 2**20:.0f} MB for "
                "a character that moves live: export it with smaller textures, or the head alone"
            )
        name, rig = path.stem, load_rig(path)
    rules = None if table is None else load_shape_rules(table)
    try:
        return Character(name, rig, shape_map(ARKIT, rig.names, rules))
    except NameMismatchError as error:
        if table is not None:
            raise NameMismatchError(f"{table}: {error}") from error
        raise NameMismatchError(
            f"{path}: found the shapes {quoted(rig.names)}, none by a name of ARKit's; expected some such as jawOpen, "
            "or --mapping FILE, a TOML table that says what drives each of them, such as\n"
            f'["{rig.names[0]}"]\nsum = {{jawOpen = 1.0}}'
        ) from error
