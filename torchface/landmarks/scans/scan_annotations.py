"""Landmarks and lines of many scans in one JSON file: what the detector learns from."""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchface.files.documents import Value, read_json
from torchface.landmarks.scans.uv_landmark_names import UV_LANDMARK_NAMES

_FORMAT = "torchface.scan-annotations/1"
_MAX_BYTES = 256 * 2**20


@dataclass(frozen=True, eq=False)
class ScanAnnotation:
    """What is known of one scan, in its own space, millimetres.

    Args:
        points: landmarks by name, each (3,).
        lines: the lines between lips and lids by name, each (N,3), from the viewer's left; may be absent.

    Example:
        >>> known = ScanAnnotation({"nose": torch.tensor([0.0, 0.0, 110.0])})
        >>> int(known.ordered().isfinite().all(1).sum())  # of twelve
        1
    """

    points: dict[str, Tensor]
    lines: dict[str, Tensor] = field(default_factory=dict)

    def ordered(self) -> Tensor:
        """The landmarks in the order of ``UV_LANDMARK_NAMES``, (12,3), NaN where one is not known."""
        missing = torch.full((3,), torch.nan, dtype=torch.float64)
        return torch.stack(
            [self.points[name].double() if name in self.points else missing for name in UV_LANDMARK_NAMES]
        )


def load_annotations(path: str | Path) -> dict[str, ScanAnnotation]:
    """Reads annotations by scan file name.

    The file holds ``{"format": "torchface.scan-annotations/1", "unit": "mm", "scans": {"a.obj": {"points":
    {"nose": [x, y, z], ...}, "lines": {"lips": [[x, y, z], ...], ...}}}}``; lines may be left out.

    Raises:
        FileFormatError: the file is missing, too large, not such JSON, or a number is none.

    Example:
        >>> from torchface.files.documents import write_json
        >>> scans = {"a.obj": {"points": {"nose": [0.0, 0.0, 110.0]}}}
        >>> write_json("annotations.json", {"format": "torchface.scan-annotations/1", "unit": "mm", "scans": scans})
        >>> load_annotations("annotations.json")["a.obj"].points["nose"].tolist()
        [0.0, 0.0, 110.0]
    """
    document = read_json(path, _FORMAT, _MAX_BYTES)
    if document["unit"].found not in (None, "mm"):
        raise document["unit"].error('"mm"')
    return {name: _annotation(one) for name, one in document["scans"].table().items()}


def _annotation(one: Value) -> ScanAnnotation:
    points, lines = one["points"].table(*UV_LANDMARK_NAMES), one["lines"].table() if one["lines"] else {}
    return ScanAnnotation(
        {name: point.tensor(3, expected="three finite numbers") for name, point in points.items()},
        {name: line.tensor(None, 3, expected="points of three finite numbers") for name, line in lines.items()},
    )
