"""Landmark points as other programs save them: menpo's LJSON, iBUG's PTS (also written), and the toolkit's own JSON."""

from array import array
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.files.documents import read_json
from torchface.files.whole_files import read_file, write_file
from torchface.io.landmarks.picks import load_correspondences

__all__ = ["LandmarkPoints", "load_landmark_points", "save_pts"]

_MAX_BYTES = 16 * 2**20
_MAX_POINTS = 1_000_000
_IBUG_GROUPS = (
    ("jaw", "chin", 17),
    ("left_eyebrow", "leyebrow", 5),
    ("right_eyebrow", "reyebrow", 5),
    ("nose", "nose", 9),
    ("left_eye", "leye", 6),
    ("right_eye", "reye", 6),
    ("mouth", "mouth", 20),
)
"""The groups of iBUG's 68 in their order, by menpo's label today and formerly, with their sizes; menpo's left is the
viewer's."""


@dataclass(frozen=True, eq=False)
class LandmarkPoints:
    """Landmarks by position.

    Args:
        points: (L,3) in the file's unit, or (L,2) pixels, x right, y down, pixel centres at integers from 0;
            NaN where the file has none.
        groups: rows by name, such as ``"nose"``, each (n,) int64; empty where the file has none.
        source: the file, for what is said of the points.
    """

    points: Tensor
    groups: dict[str, Tensor] = field(default_factory=dict)
    source: str = "landmarks"

    def ibug(self) -> Tensor:
        """The points (68,2) in iBUG's order: jaw, brows, nose, eyes, mouth, each from the viewer's left.

        A file with groups is read by them, whatever the order of its rows; groups beside those are left aside,
        and menpo's ``all`` alone means the file's order.

        Raises:
            NameMismatchError: the groups are not those of menpo's 68.
            ShapeError: there are not 68, or a group has another number of points than iBUG's.
        """
        rows = self._ibug_rows() if set(self.groups) - {"all"} else torch.arange(len(self.points))
        if len(rows) != 68:
            raise ShapeError(f"{self.source}: found {len(rows)}, expected 68 landmarks in iBUG's order")
        return self.points[rows]

    def _ibug_rows(self) -> Tensor:
        listed, missing, chosen = ", ".join(self.groups), [], []
        for label, former, count in _IBUG_GROUPS:
            name = label if label in self.groups else former
            rows = self.groups.get(name)
            if rows is None:
                missing.append(label)
                continue
            if len(rows) != count:
                raise ShapeError(f"{self.source}: found {len(rows)} points under {name!r}, expected iBUG's {count}")
            chosen.append(rows)
        if missing:
            expected = ", ".join(label for label, _, _ in _IBUG_GROUPS)
            raise NameMismatchError(
                f"{self.source}: found the groups {listed}, expected {expected}, menpo's labels of iBUG's 68 "
                f"(none for {', '.join(missing)})"
            )
        order = torch.cat(chosen)
        if len(order.unique()) != len(order):
            found = f"points that belong to two of the groups {listed}"
            raise ShapeError(f"{self.source}: found {found}, expected one each")
        return order


def load_landmark_points(path: str | Path) -> LandmarkPoints:
    r"""Reads landmarks by the file's ending: ``.ljson``, ``.pts``, or ``.json`` (correspondences, or LJSON).

    Args:
        path: the file. PTS counts pixels from 1, LJSON gives two-dimensional points as (y, x): both come as (x, y)
            from 0.

    Raises:
        FileFormatError: another ending, or other content than the ending means.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("face.pts").write_text("version: 1\nn_points: 1\n{\n11 21\n}\n")
        >>> load_landmark_points("face.pts").points.tolist()
        [[10.0, 20.0]]
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending == ".pts":
        return _pts(path)
    if ending not in (".ljson", ".json"):
        raise FileFormatError(f"{path}: found the ending {ending!r}, expected .ljson, .pts or .json")
    document = read_json(path, max_bytes=_MAX_BYTES).found
    if ending == ".json" and isinstance(document, dict) and "format" in document:
        return LandmarkPoints(load_correspondences(path).points, source=str(path))
    return _ljson(path, document)


def save_pts(points: Tensor, path: str | Path) -> None:
    """Writes landmarks in an image as iBUG's PTS, which counts pixels from 1.

    Args:
        points: (L,2) pixels, x right, y down, pixel centres at integers from 0.
        path: the file.

    Raises:
        ShapeError: not (L,2).
        ValueRangeError: a position is NaN or infinite; PTS has no way to say so.
        FileFormatError: the file cannot be written.

    Example:
        >>> save_pts(torch.tensor([[10.0, 20.0]]), "face.pts")
        >>> load_landmark_points("face.pts").points.tolist()
        [[10.0, 20.0]]
    """
    if points.ndim != 2 or points.shape[1] != 2 or len(points) == 0:
        raise ShapeError(f"points: found {tuple(points.shape)}, expected (L,2)")
    if not bool(torch.isfinite(points).all()):
        raise ValueRangeError(f"{path}: found points that are NaN or infinite, expected numbers")
    rows = "\n".join(f"{x + 1:.3f} {y + 1:.3f}" for x, y in points.double().tolist())
    write_file(path, f"version: 1\nn_points: {len(points)}\n{{\n{rows}\n}}\n".encode())


def _ljson(path: Path, document: Any) -> LandmarkPoints:
    """Versions 1 (a list of groups), 2 (one set of points) and 3 (sets by name; one is expected)."""
    if not isinstance(document, dict) or document.get("version") not in (1, 2, 3):
        raise FileFormatError(f'{path}: found no field "version" of 1, 2 or 3, expected LJSON landmarks')
    if document["version"] == 1:
        return _first_version(path, document)
    entry = document
    if document["version"] == 3:
        sets = document.get("groups")
        if not isinstance(sets, dict) or len(sets) != 1:
            count = len(sets) if isinstance(sets, dict) else "no"
            raise FileFormatError(f'{path}: found {count} sets of landmarks under "groups", expected one')
        entry = next(iter(sets.values()))
    landmarks = entry.get("landmarks") if isinstance(entry, dict) else None
    points = _points(path, landmarks.get("points") if isinstance(landmarks, dict) else None)
    labels = entry.get("labels") or []
    if not isinstance(labels, list):
        raise FileFormatError(f'{path}: found no list under "labels", expected one')
    groups = {}
    for label in labels:  # a name a turn
        name, rows = (label.get("label"), label.get("mask")) if isinstance(label, dict) else (None, None)
        fits = isinstance(rows, list) and all(type(row) is int and 0 <= row < len(points) for row in rows)
        if not isinstance(name, str) or not fits:
            raise FileFormatError(f"{path}: found a label without a name or with rows outside 0 to {len(points) - 1}")
        groups[name] = torch.tensor(rows, dtype=torch.int64)
    return LandmarkPoints(points, groups, str(path))


def _first_version(path: Path, document: dict[str, Any]) -> LandmarkPoints:
    sets = document.get("groups")
    rows: list[Any] = []
    groups = {}
    for entry in sets if isinstance(sets, list) else []:
        marks = entry.get("landmarks") if isinstance(entry, dict) else None
        if not isinstance(marks, list) or not isinstance(entry.get("label"), str):
            raise FileFormatError(f"{path}: found a group without label or landmarks, expected both")
        groups[entry["label"]] = torch.arange(len(rows), len(rows) + len(marks))
        rows += [mark.get("point") if isinstance(mark, dict) else None for mark in marks]
    return LandmarkPoints(_points(path, rows), groups, str(path))


def _points(path: Path, rows: Any) -> Tensor:
    """(L,3), or (L,2) turned from (y, x) to (x, y); null is NaN."""
    width = len(rows[0]) if isinstance(rows, list) and rows and isinstance(rows[0], list) else 0
    if width not in (2, 3) or len(rows) > _MAX_POINTS:
        raise FileFormatError(f"{path}: found no list of two- or three-dimensional points, expected landmarks")
    numbers = [[float("nan") if x is None else x for x in row] if isinstance(row, list) else [] for row in rows]
    if any(len(row) != width or not all(type(x) in (int, float) for x in row) for row in numbers):
        raise FileFormatError(f"{path}: found points of different width or that are no numbers, expected {width} each")
    try:
        points = torch.tensor(numbers, dtype=torch.float64)
    except (OverflowError, RuntimeError, ValueError) as error:
        raise FileFormatError(f"{path}: found a number too large for a position ({error})") from error
    if torch.isinf(points).any():
        raise FileFormatError(f"{path}: found an infinite position, expected finite numbers or null")
    return points.flip(1) if width == 2 else points


def _pts(path: Path) -> LandmarkPoints:
    text = read_file(path, _MAX_BYTES).decode("utf-8", "replace")
    head, brace, rest = text.partition("{")
    body, end, _ = rest.partition("}")
    if not brace or not end:
        raise FileFormatError(f"{path}: found no points between braces, expected iBUG's PTS")
    declared = [line.partition(":")[2].strip() for line in head.splitlines() if line.strip().startswith("n_points")]
    numbers = array("d")
    width = count = 0
    try:
        for line in StringIO(body):  # text comes by the line
            if words := line.split():
                numbers.extend(map(float, words))
                count, width = count + 1, width or len(words)
                if len(words) != width or width not in (2, 3):
                    raise FileFormatError(f"{path}: found rows of different width, expected two or three numbers each")
    except ValueError as error:
        raise FileFormatError(f"{path}: found text among the points, expected numbers ({error})") from error
    if declared and declared[0] != str(count):
        raise FileFormatError(f"{path}: found {count} points, expected the n_points: {declared[0]:.40} of its head")
    if not 0 < count <= _MAX_POINTS:
        raise FileFormatError(f"{path}: found {count} points, expected 1 to {_MAX_POINTS}")
    points = torch.tensor(numbers, dtype=torch.float64).reshape(count, width)
    if torch.isinf(points).any():
        raise FileFormatError(f"{path}: found an infinite position, expected finite numbers")
    return LandmarkPoints(points - 1 if points.shape[1] == 2 else points, source=str(path))
