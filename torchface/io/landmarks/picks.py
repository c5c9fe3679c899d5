"""Points picked by hand, as JSON: landmark vertices of a mesh, and pairs of template vertex and scan point."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, TopologyError
from torchface.files.documents import Value, read_json, write_json
from torchface.mesh import Mesh, other_topology

_LANDMARKS, _CORRESPONDENCES = "torchface.landmarks/1", "torchface.correspondences/1"
_MAX_BYTES = 16 * 2**20


@dataclass(frozen=True, eq=False)
class LandmarkVertices:
    """Named vertices of a mesh.

    Args:
        vertices: ids, (L,) int64.
        labels: one a landmark, none twice.
        fingerprint: ``Mesh.fingerprint()`` of the mesh, where known.

    Raises:
        ShapeError, NameMismatchError: the parts do not fit each other.

    Example:
        >>> LandmarkVertices(torch.tensor([0, 2]), ("nose",))
        Traceback (most recent call last):
            ...
        torchface.errors.NameMismatchError: labels: found 1 distinct ones for 2 vertices
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

    Example:
        >>> pairs = Correspondences(torch.tensor([0, 2]), torch.tensor([[1.0, 0, 0], [0, 0, 1]]), ("nose", "chin"))
        >>> pairs.check(Mesh(torch.eye(3)[:2], torch.zeros(0, 3, dtype=torch.int64)))
        Traceback (most recent call last):
            ...
        torchface.errors.TopologyError: picks: found vertex ids 0 to 2, expected 0 to 1
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
    """Writes landmark vertices as JSON; the file appears only when it is complete.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> ears = LandmarkVertices(head.landmarks[[0, 16]], ("right", "left"), head.fingerprint())
        >>> save_landmarks(ears, "landmarks.json")
        >>> load_landmarks("landmarks.json").check(head)
    """
    _write(path, _LANDMARKS, landmarks, {})


def load_landmarks(path: str | Path) -> LandmarkVertices:
    """Reads what :func:`save_landmarks` wrote.

    Raises:
        FileFormatError: the file is missing, too large, not JSON, or a field is missing or of another kind.

    Example:
        >>> save_landmarks(LandmarkVertices(torch.tensor([17, 4]), ("nose", "chin")), "landmarks.json")
        >>> load_landmarks("landmarks.json").vertices.tolist()
        [17, 4]
    """
    return LandmarkVertices(*_picks(read_json(path, _LANDMARKS, _MAX_BYTES)))


def save_correspondences(pairs: Correspondences, path: str | Path) -> None:
    """Writes pairs as JSON; the file appears only when it is complete.

    Example:
        >>> pairs = Correspondences(torch.tensor([4]), torch.tensor([[0.0, 5.0, 9.0]]), ("nose",))
        >>> save_correspondences(pairs, "pairs.json")
        >>> load_correspondences("pairs.json").labels
        ('nose',)
    """
    _write(path, _CORRESPONDENCES, pairs, {"points": pairs.points.tolist()})


def load_correspondences(path: str | Path) -> Correspondences:
    """Reads what :func:`save_correspondences` wrote.

    Raises:
        FileFormatError: the file is missing, too large, not JSON, or a field is missing or of another kind.

    Example:
        >>> pairs = Correspondences(torch.tensor([4]), torch.tensor([[0.0, 5.0, 9.0]]), ("nose",))
        >>> save_correspondences(pairs, "pairs.json")
        >>> load_correspondences("pairs.json").points.tolist()
        [[0.0, 5.0, 9.0]]
    """
    document = read_json(path, _CORRESPONDENCES, _MAX_BYTES)
    vertices, labels, fingerprint = _picks(document)
    points = document["points"].tensor(len(vertices), 3, expected=f"three numbers for each of {len(vertices)} vertices")
    return Correspondences(vertices, points, labels, fingerprint)


def _write(path: str | Path, kind: str, picks: LandmarkVertices | Correspondences, more: dict[str, Any]) -> None:
    document = {
        "format": kind,
        "fingerprint": picks.fingerprint,
        "labels": list(picks.labels),
        "vertices": picks.vertices.tolist(),
        **more,
    }
    write_json(path, document)


def _picks(document: Value) -> tuple[Tensor, tuple[str, ...], str | None]:
    """Vertices, labels and fingerprint."""
    vertices = document["vertices"].tensor(None, dtype=torch.int64, expected="a list of vertex ids")
    labels, fingerprint = document["labels"].texts(), document["fingerprint"]
    if not len(labels) == len(set(labels)) == len(vertices):
        raise document["labels"].error(f"{len(vertices)} distinct labels, one a vertex")
    return vertices, labels, fingerprint.text() if fingerprint else None


def _check_labels(vertices: Tensor, labels: tuple[str, ...]) -> None:
    if vertices.ndim != 1 or vertices.dtype != torch.int64:
        raise ShapeError(f"vertices: found {vertices.dtype} {tuple(vertices.shape)}, expected torch.int64 (L,)")
    if len(labels) != len(vertices) or len(set(labels)) != len(labels):
        raise NameMismatchError(f"labels: found {len(set(labels))} distinct ones for {len(vertices)} vertices")


def _check_mesh(vertices: Tensor, fingerprint: str | None, mesh: Mesh) -> None:
    if fingerprint is not None and fingerprint != mesh.fingerprint():
        raise TopologyError(
            f"picks: made for {other_topology(fingerprint, mesh)}; give the mesh that they were picked on, or pick "
            "anew (torchface pick)"
        )
    if len(vertices) and (int(vertices.min()) < 0 or int(vertices.max()) >= len(mesh.vertices)):
        raise TopologyError(
            f"picks: found vertex ids {int(vertices.min())} to {int(vertices.max())}, "
            f"expected 0 to {len(mesh.vertices) - 1}"
        )
