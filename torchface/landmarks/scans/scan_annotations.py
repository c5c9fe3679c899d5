"""Landmarks and lines of many scans in one JSON file: what the detector learns from."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file, write_file
from torchface.landmarks.scans.twelve_landmarks import TWELVE

_FORMAT = "torchface.scan-annotations/1"
_LARGEST_FILE = 256 * 2**20


@dataclass(frozen=True, eq=False)
class ScanAnnotation:
    """What is known of one scan, in its own space, millimetres.

    Args:
        points: landmarks by name, each (3,).
        lines: the lines between lips and lids by name, each (N,3), from the viewer's left; may be absent.
    """

    points: dict[str, Tensor]
    lines: dict[str, Tensor] = field(default_factory=dict)

    def twelve(self) -> Tensor:
        """The landmarks in the order of ``TWELVE``, (12,3), NaN where one is not known."""
        missing = torch.full((3,), torch.nan, dtype=torch.float64)
        return torch.stack([self.points[name].double() if name in self.points else missing for name in TWELVE])


def save_annotations(annotations: Mapping[str, ScanAnnotation], path: str | Path) -> None:
    """Writes annotations by scan file name as JSON; the file appears only when it is complete."""
    scans = {
        name: {
            "points": {label: point.tolist() for label, point in one.points.items()},
            "lines": {label: line.tolist() for label, line in one.lines.items()},
        }
        for name, one in annotations.items()
    }
    write_file(path, json.dumps({"format": _FORMAT, "unit": "mm", "scans": scans}, indent=1).encode())


def load_annotations(path: str | Path) -> dict[str, ScanAnnotation]:
    """Reads annotations by scan file name.

    The file holds ``{"format": "torchface.scan-annotations/1", "unit": "mm", "scans": {"a.obj": {"points":
    {"nose": [x, y, z], ...}, "lines": {"lips": [[x, y, z], ...], ...}}}}``; lines may be left out.

    Raises:
        FileFormatError: the file is missing, too large, not such JSON, or a number is none.
    """
    try:
        document = json.loads(read_file(path, _LARGEST_FILE))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: not JSON ({error})") from error
    scans = document.get("scans") if isinstance(document, dict) and document.get("format") == _FORMAT else None
    if not isinstance(scans, dict) or document.get("unit", "mm") != "mm":
        raise FileFormatError(f'{path}: found no "format": "{_FORMAT}" with "scans" in "mm", expected annotations')
    return {str(name): _annotation(path, name, one) for name, one in scans.items()}


def _annotation(path: str | Path, name: str, one: Any) -> ScanAnnotation:
    points = one.get("points") if isinstance(one, dict) else None
    lines = one.get("lines", {}) if isinstance(one, dict) else None
    if not isinstance(points, dict) or not isinstance(lines, dict):
        raise FileFormatError(f"{path}: {name}: found no points by name, expected them")
    unknown = [label for label in points if label not in TWELVE]
    if unknown:
        raise FileFormatError(f"{path}: {name}: found landmark {unknown[0]!r}, expected one of {', '.join(TWELVE)}")
    return ScanAnnotation(
        {label: _rows(path, f"{name}: {label}", [point])[0] for label, point in points.items()},
        {label: _rows(path, f"{name}: {label}", line) for label, line in lines.items()},
    )


def _rows(path: str | Path, what: str, rows: Any) -> Tensor:
    good = isinstance(rows, list) and all(isinstance(row, list) and len(row) == 3 for row in rows)
    if not good or not all(type(x) in (int, float) and math.isfinite(x) and abs(x) < 1e9 for row in rows for x in row):
        raise FileFormatError(f"{path}: {what}: found no points of three finite numbers, expected them")
    return torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)
