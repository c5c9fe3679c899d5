"""Sites of markers on a mesh: a triangle and barycentric coordinates each."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.errors import (
    ArgumentTypeError,
    FileFormatError,
    NameMismatchError,
    ShapeError,
    TopologyError,
    ValueRangeError,
)
from torchface.files.documents import read_json, write_json
from torchface.geometry.similarity import similarity_transform
from torchface.mesh import Mesh, other_topology
from torchface.number_checks import as_real, as_tensor, checked_type

_FORMAT = "torchface.attachment/1"
_MAX_FILE = 64 * 2**20


@dataclass(frozen=True, eq=False)
class Attachment:
    """M points fixed to the triangles of a mesh.

    Args:
        triangles: rows of the mesh's faces, (M,) int64.
        barycentric: weights of each triangle's corners, (M,3), rows sum to 1.
        labels: marker labels, no label twice; ``marker000``, ... if absent.
        residual: what was left between marker and surface, (M,3), millimetres.
        fingerprint: ``Mesh.fingerprint()`` of the mesh it was made for, checked where there is one.
        rest: the points on the mesh that it was made for, (M,3), millimetres; see :meth:`rest_distance`.

    Raises:
        ShapeError, NameMismatchError, ValueRangeError: the parts do not fit each other.

    Example:
        >>> from torchface import Mesh
        >>> face = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))
        >>> middle = Attachment(torch.tensor([0]), torch.full((1, 3), 1 / 3), ("cheek",))
        >>> middle.on(face.faces, 3 * face.vertices).round(decimals=3).tolist()
        [[1.0, 1.0, 1.0]]
    """

    triangles: Tensor
    barycentric: Tensor
    labels: tuple[str, ...] | None = None
    residual: Tensor | None = None
    fingerprint: str | None = None
    rest: Tensor | None = None

    def __post_init__(self) -> None:
        for name, shape, dtype in (("triangles", "(M,)", torch.int64), ("barycentric", "(M,3)", None)):
            value = as_tensor(name, getattr(self, name), shape, dtype or torch.get_default_dtype())
            object.__setattr__(self, name, value)
        if self.triangles.is_floating_point():
            raise ArgumentTypeError(f"triangles: found {self.triangles.dtype}, expected whole numbers (M,)")
        count = len(self.triangles)
        if self.triangles.shape != (count,) or self.barycentric.shape != (count, 3):
            raise ShapeError(
                f"attachment: found triangles {tuple(self.triangles.shape)} and barycentric "
                f"{tuple(self.barycentric.shape)}, expected (M,) and (M,3)"
            )
        if not torch.isfinite(self.barycentric).all() or (self.barycentric.sum(1) - 1).abs().gt(1e-3).any():
            raise ValueRangeError("attachment: barycentric rows must be finite and sum to 1")
        for name, points in (("residual", self.residual), ("rest", self.rest)):
            if points is not None and points.shape != (count, 3):
                raise ShapeError(f"attachment: found {name} {tuple(points.shape)}, expected ({count},3)")
        labels = tuple(f"marker{i:03d}" for i in range(count)) if self.labels is None else tuple(self.labels)
        if len(labels) != count or len(set(labels)) != count:
            raise NameMismatchError(f"attachment: found {len(set(labels))} distinct labels for {count} markers")
        object.__setattr__(self, "labels", labels)

    @staticmethod
    def from_vertices(mesh: Mesh, ids: Tensor | Sequence[int], labels: Sequence[str] | None = None) -> "Attachment":
        """Markers that sit on vertices ``ids`` (M,).

        Raises:
            TopologyError: an id is outside the mesh, or its vertex belongs to no triangle.

        Example:
            >>> from torchface.synthetic import neutral_head
            >>> face = neutral_head(texture=False)
            >>> sites = Attachment.from_vertices(face, face.landmarks[[30, 8]], ["nose", "chin"])
            >>> torch.allclose(sites.on(face.faces, face.vertices), face.vertices[face.landmarks[[30, 8]]])
            True
        """
        checked_type("mesh", mesh, Mesh)
        ids = as_tensor("ids", ids if isinstance(ids, Tensor | np.ndarray) else list(ids), "(M,)", torch.int64)
        if ids.is_floating_point():
            raise ArgumentTypeError(f"ids: found {ids.dtype}, expected whole numbers (M,)")
        ids = ids.long()
        if ids.numel() and (int(ids.min()) < 0 or int(ids.max()) >= len(mesh.vertices)):
            raise TopologyError(
                f"attachment: found vertex ids {int(ids.min())} to {int(ids.max())}, "
                f"expected 0 to {len(mesh.vertices) - 1}"
            )
        faces = mesh.faces.cpu()
        corner_of = torch.full((len(mesh.vertices),), -1, dtype=torch.int64)
        # A vertex has many corners: the last one, whatever the threads do.
        corner_of.scatter_reduce_(0, faces.flatten(), torch.arange(faces.numel()), "amax")
        corners = corner_of[ids]
        if (corners < 0).any():
            loose = ids[corners < 0].tolist()
            raise TopologyError(f"attachment: vertices {loose[:5]} belong to no triangle; a marker needs one")
        barycentric = torch.nn.functional.one_hot(corners % 3, 3).to(torch.float32)
        return Attachment(corners // 3, barycentric, None if labels is None else tuple(labels)).made_for(mesh)

    def made_for(self, mesh: Mesh) -> "Attachment":
        """The same with the fingerprint and the points at rest of a mesh, by which another head's is noticed."""
        rest = self.on(mesh.faces.cpu(), mesh.vertices.detach().cpu()).float()
        return replace(self, fingerprint=mesh.fingerprint(), rest=rest)

    def rest_distance(self, mesh: Mesh) -> float:
        """How far the points at rest are from those on ``mesh`` after a rigid motion, median, millimetres.

        Hardly anything on the head that it was made for, however it was moved; 0.6 to 6 mm on another. NaN where it
        does not say, as files of torchface 1.0, and where the points are fewer than three.

        Example:
            >>> face = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))
            >>> sites = Attachment.from_vertices(face, [0, 1, 2])
            >>> round(sites.rest_distance(face.with_vertices(face.vertices + 5)), 3)
            0.0
        """
        if self.rest is None or len(self.rest) < 3:
            return math.nan
        here = self.on(mesh.faces.cpu(), mesh.vertices.detach().cpu()).double()
        there = self.rest.double()
        moved = similarity_transform(there[None], here[None], scale=False).apply(there)[0]
        return float((moved - here).norm(dim=1).median())

    def check(self, mesh: Mesh, source: str | Path = "attachment", owner: str | Path = "the mesh") -> None:
        """Raises ``TopologyError`` where this attachment cannot belong to ``mesh``.

        Args:
            mesh: what it is to sit on.
            source, owner: what to call the attachment and the mesh in the message: their files, where known.
        """
        if self.fingerprint is not None and self.fingerprint != mesh.fingerprint():
            raise TopologyError(
                f"{source}: found marker sites made for {other_topology(self.fingerprint, mesh, owner)}; give the rig "
                "that they were made for (with the same --part), or find the sites on this one (torchface attach)"
            )
        if len(self.triangles) and (int(self.triangles.min()) < 0 or int(self.triangles.max()) >= len(mesh.faces)):
            raise TopologyError(
                f"{source}: found triangles {int(self.triangles.min())} to {int(self.triangles.max())}, "
                f"expected 0 to {len(mesh.faces) - 1}"
            )

    def on(self, faces: Tensor, vertices: Tensor) -> Tensor:
        """The points (...,M,3) on ``vertices`` (...,V,3); linear, so deltas go in as well as positions."""
        vertices = as_real(vertices, "vertices")
        corners = faces[self.triangles.to(faces.device)]
        return (vertices[..., corners, :] * self.barycentric.to(vertices)[..., None]).sum(-2)

    def select(self, labels: Sequence[str]) -> "Attachment":
        """The markers of these labels, in this order."""
        row = {label: i for i, label in enumerate(self.labels or ())}
        missing = [label for label in labels if label not in row]
        if missing:
            raise NameMismatchError(f"attachment: no marker {', '.join(map(repr, missing[:5]))} among its {len(row)}")
        ids = torch.tensor([row[label] for label in labels], dtype=torch.int64)
        return Attachment(
            self.triangles[ids],
            self.barycentric[ids],
            tuple(labels),
            None if self.residual is None else self.residual[ids],
            self.fingerprint,
            None if self.rest is None else self.rest[ids],
        )

    def save(self, path: str | Path) -> None:
        """Writes JSON; the file appears only when it is complete."""
        document = {
            "format": _FORMAT,
            "fingerprint": self.fingerprint,
            "labels": list(self.labels or ()),
            "triangles": self.triangles.tolist(),
            "barycentric": self.barycentric.tolist(),
            "residual": None if self.residual is None else self.residual.tolist(),
            "rest": None if self.rest is None else self.rest.tolist(),
        }
        write_json(path, document)

    @staticmethod
    def load(path: str | Path) -> "Attachment":
        """Reads what ``save`` wrote.

        Raises:
            FileFormatError: the file is missing, too large, not JSON, or lacks a field.
        """
        document = read_json(path, _FORMAT, _MAX_FILE)
        triangles = document["triangles"].tensor(None, dtype=torch.int64, expected="a list of triangles")
        residual, fingerprint, rest = document["residual"], document["fingerprint"], document["rest"]
        try:
            return Attachment(
                triangles,
                document["barycentric"].tensor(len(triangles), 3, dtype=torch.float32),
                document["labels"].texts(),
                residual.tensor(len(triangles), 3, dtype=torch.float32) if residual else None,
                fingerprint.text() if fingerprint else None,
                rest.tensor(len(triangles), 3, dtype=torch.float32) if rest else None,
            )
        except (ShapeError, NameMismatchError, ValueRangeError) as error:
            raise FileFormatError(f"{path}: {error}") from error
