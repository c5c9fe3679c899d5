"""Points picked by hand, as JSON: landmark vertices of a mesh, and pairs of template vertex and scan point."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.errors import FileFormatError, NameMismatchError, ShapeError, TopologyError
from torchface.files.whole_files import read_file, write_file
from torchface.mesh import Mesh

_LANDMARKS, _CORRESPONDENCES = "torchface.landmarks/1", "torchface.correspondences/1"
_LARGEST_FILE = 16 * 2**20


@dataclass(frozen=True, eq=False)
class LandmarkVertices:
    """Named vertices of a mesh.

    Args:
        vertices: ids, (L,) int64.
        labels: one a landmark, none twice.
        fingerprint: ``Mesh.fingerprint()`` of the mesh, where known.

    Raises:
        ShapeError, NameMismatchError: the parts do not fit each other.
    """

    vertices: Tensor
    labels: tuple[str, ...]
    fingerprint: str | None = None

    def __post_init__(self) -> None:
        _check_labels(self.vertices, self.labels)

    def check(self, mesh: Mesh) -> None:
        """Raises ``TopologyError`` where these cannot belong to ``mesh``."""
        _check_mesh(self.vertices, self.fingerprint, mesh)


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Where vertices of a template lie on a scan: what ``register`` takes as ``landmarks``.

    Args:
        vertices: ids on the template, (L,) int64.
        points: on the scan, (L,3), millimetres in its own space.
        labels: one a pair, none twice.
        fingerprint: of the template, where known.

    Raises:
        ShapeError, NameMismatchError: the parts do not fit each other.
    """

    vertices: Tensor
    points: Tensor
    labels: tuple[str, ...]
    fingerprint: str | None = None

    def __post_init__(self) -> None:
        _check_labels(self.vertices, self.labels)
        if self.points.shape != (len(self.vertices), 3):
            raise ShapeError(f"points: found {tuple(self.points.shape)}, expected ({len(self.vertices)},3)")

    def check(self, template: Mesh) -> None:
        """Raises ``TopologyError`` where these cannot belong to ``template``."""
        _check_mesh(self.vertices, self.fingerprint, template)


def save_landmarks(landmarks: LandmarkVertices, path: str | Path) -> None:
    """Writes landmark vertices as JSON; the file appears only when it is complete."""
    _write(path, _LANDMARKS, landmarks, {})


def load_landmarks(path: str | Path) -> LandmarkVertices:
    """Reads what :func:`save_landmarks` wrote.

    Raises:
        FileFormatError: the file is missing, too large, not JSON, or a field is missing or of another kind.
    """
    document = _read(path, _LANDMARKS)
    return LandmarkVertices(_vertices(document, path), _labels(document, path), _fingerprint(document, path))


def save_correspondences(pairs: Correspondences, path: str | Path) -> None:
    """Writes pairs as JSON; the file appears only when it is complete."""
    _write(path, _CORRESPONDENCES, pairs, {"points": pairs.points.tolist()})


def load_correspondences(path: str | Path) -> Correspondences:
    """Reads what :func:`save_correspondences` wrote.

    Raises:
        FileFormatError: the file is missing, too large, not JSON, or a field is missing or of another kind.
    """
    document = _read(path, _CORRESPONDENCES)
    vertices, points = _vertices(document, path), document.get("points")
    good = isinstance(points, list) and len(points) == len(vertices) and all(map(_is_point, points))
    if not good:
        raise FileFormatError(f"{path}: found no {len(vertices)} points under 'points', expected three numbers a pair")
    values = torch.tensor(points, dtype=torch.float64).reshape(-1, 3)
    return Correspondences(vertices, values, _labels(document, path), _fingerprint(document, path))


def _write(path: str | Path, kind: str, picks: LandmarkVertices | Correspondences, more: dict[str, Any]) -> None:
    document = {
        "format": kind,
        "fingerprint": picks.fingerprint,
        "labels": list(picks.labels),
        "vertices": picks.vertices.tolist(),
        **more,
    }
    write_file(path, json.dumps(document, indent=1).encode())


def _read(path: str | Path, kind: str) -> dict[str, Any]:
    try:
        document = json.loads(read_file(path, _LARGEST_FILE))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: not JSON ({error})") from error
    if not isinstance(document, dict) or document.get("format") != kind:
        raise FileFormatError(f'{path}: found no field "format": "{kind}", expected it')
    return document


def _vertices(document: dict[str, Any], path: str | Path) -> Tensor:
    found = document.get("vertices")
    if not isinstance(found, list) or not all(type(i) is int and 0 <= i < 2**31 for i in found):
        raise FileFormatError(f"{path}: found no list of vertex ids under 'vertices', expected one")
    return torch.tensor(found, dtype=torch.int64)


def _labels(document: dict[str, Any], path: str | Path) -> tuple[str, ...]:
    found, count = document.get("labels"), len(document["vertices"])
    if not isinstance(found, list) or not all(isinstance(label, str) for label in found):
        raise FileFormatError(f"{path}: found no list of texts under 'labels', expected one")
    if len(set(found)) != count or len(found) != count:
        raise FileFormatError(
            f"{path}: found {len(set(found))} distinct labels, expected one for each of {count} vertices"
        )
    return tuple(found)


def _fingerprint(document: dict[str, Any], path: str | Path) -> str | None:
    found = document.get("fingerprint")
    if found is not None and not isinstance(found, str):
        raise FileFormatError(f"{path}: found a fingerprint that is no text, expected a mesh's")
    return found


def _is_point(point: object) -> bool:
    if not isinstance(point, list) or len(point) != 3:
        return False
    return all(type(x) in (int, float) and abs(x) < 1e9 and math.isfinite(x) for x in point)


def _check_labels(vertices: Tensor, labels: tuple[str, ...]) -> None:
    if vertices.ndim != 1 or vertices.dtype != torch.int64:
        raise ShapeError(f"vertices: found {vertices.dtype} {tuple(vertices.shape)}, expected torch.int64 (L,)")
    if len(labels) != len(vertices) or len(set(labels)) != len(labels):
        raise NameMismatchError(f"labels: found {len(set(labels))} distinct ones for {len(vertices)} vertices")


def _check_mesh(vertices: Tensor, fingerprint: str | None, mesh: Mesh) -> None:
    if fingerprint is not None and fingerprint != mesh.fingerprint():
        raise TopologyError(
            f"picks: made for topology {fingerprint}, the mesh has {mesh.fingerprint()} "
            "(vertex count, hash of the triangles)"
        )
    if len(vertices) and (int(vertices.min()) < 0 or int(vertices.max()) >= len(mesh.vertices)):
        raise TopologyError(
            f"picks: found vertex ids {int(vertices.min())} to {int(vertices.max())}, "
            f"expected 0 to {len(mesh.vertices) - 1}"
        )
