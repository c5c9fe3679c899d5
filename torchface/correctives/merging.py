"""Correctives of a rig in which shapes were renamed, and some of them summed under one name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import torch

from torchface.correctives.activation import CorrectiveActivation
from torchface.correctives.definitions import Corrective, Correctives
from torchface.errors import NameMismatchError


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
