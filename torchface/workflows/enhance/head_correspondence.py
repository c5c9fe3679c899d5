"""The correspondence of another head with the model's dense mesh: by topology, registration, or given pairs."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.enhancement.coarse_level import coarse_level
from torchface.enhancement.thin_shell import LEAST_POINTS, ThinShell
from torchface.errors import AlignmentError, FileFormatError, ShapeError, TopologyError, ValueRangeError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.meshes.unit_check import extent
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.io.landmarks.picks import load_correspondences
from torchface.io.tables.csv_table import TableReader
from torchface.mesh import Mesh, submesh
from torchface.progress import Progress
from torchface.registration import register
from torchface.workflows.enhance.coarse_animation import check_scale, residual_notes

_METHOD = "enhance: correspondence/2"
_NEAR, _NEAR_BY_PAIRS = 2.0, 6.0
_SMALLEST, _LARGEST = 0.12, 5.8  # of the model's extent: a whole person beside a face, or a face beside a whole person
_MOST_POINTS = 5000
_FEWEST_LANDMARKS = 3
_ALIKE = 0.5  # cosine between two surfaces that are to be one
_COLUMNS = ("input", "model")

PLACE = "the result has the place, direction and size of the model's head, not those of the input's"
"""What users read whose input has a space of its own."""


@dataclass(frozen=True, eq=False)
class HeadCorrespondence:
    """How another head lies on the model's."""

    pose: Similarity  # from its space to the model's, a batch of one
    bent: Tensor  # its vertices at rest, bent onto the model's surface, (N,3), millimetres of the model's space
    known: Tensor  # which of them lie on that surface, (N,) bool
    residual: float  # root mean square distance between bent and what the pose alone gives, of the known, millimetres
    how: str = ""  # its vertices were found to lie there, in words; empty where they are the model's own
    asked: int = 0  # how many of them were looked for; 0 if all

    def notes(self, path: Path) -> list[str]:
        """Lines for people to read on the head of a file."""
        notes = residual_notes(self.residual, path)
        if not self.how:
            return notes
        found, asked = int(self.known.sum()), self.asked or len(self.known)
        return [
            f"{path.name}: {found} of {asked} vertices ({found / asked:.0%}) have a place on the model by "
            f"{self.how}; scaled by {float(self.pose.scale[0]):.3f}, bent by {self.residual:.2f} mm (root "
            "mean square)",
            *notes,
        ]

    def carrier(self, head: Mesh, model: Mesh, path: Path) -> Callable[[Tensor], Tensor]:
        """What carries the head's vertices (t,N,3) to the model's (t,V,3), by the thin shell where they differ."""
        if not self.how:
            return lambda vertices: placed(self.pose, vertices)
        ids, sites = self.on_model(SurfaceIndex(model.vertices, model.faces), head.faces)
        if len(ids) < LEAST_POINTS:
            raise AlignmentError(
                f"{path}: found {len(ids)} vertices with a place on the model, expected at least {LEAST_POINTS}; give "
                "pairs (--pairs), or bring the input's neutral nearer to the model's"
            )
        shell = ThinShell(model.vertices, model.faces, sites)
        rest = self.pose.apply(head.vertices[ids].double())[0]
        return lambda vertices: shell.follow(placed(self.pose, vertices[:, ids]), rest)

    def on_model(self, surface: SurfaceIndex, faces: Tensor) -> tuple[Tensor, Attachment]:
        """At most 5,000 known vertices, spread evenly, (M,), and where they lie on the model's surface.

        A vertex whose surface faces another way than the model's does there has come to lie on the other lip or lid,
        and is left out.
        """
        ids = self.sparse_points(faces)
        nearest = surface.nearest(self.bent[ids])
        normals = vertex_normals(self.bent.double(), faces)[ids]
        alike = (normals * surface.normals_at(nearest)).sum(-1) > _ALIKE
        return ids[alike], Attachment(nearest.triangle[alike], nearest.barycentric[alike].float())

    def sparse_points(self, faces: Tensor) -> Tensor:
        """Numbers of at most 5,000 known vertices, spread evenly, (M,)."""
        ids = self.known.nonzero()[:, 0]
        if len(ids) <= _MOST_POINTS:
            return ids
        level = coarse_level(self.bent, faces, int(_MOST_POINTS * len(self.known) / len(ids))).vertex_ids
        return level[self.known[level]][:_MOST_POINTS]


def find_correspondence(
    head: Mesh, model: Mesh, pairs: Path | None, path: Path, state: Path, progress: Progress
) -> HeadCorrespondence:
    """Aligns a head at rest with the model's and bends it onto its surface, by pairs for one of another topology,
    else by registration; the file ``state`` keeps the correspondence for a later run."""
    if has_topology_of(head, model):
        vertices, target = head.vertices.double(), model.vertices.double()
        pose = similarity_transform(vertices[None], target[None])
        check_scale(float(pose.scale[0]), path)
        residual = float((pose.apply(vertices[None])[0] - target).square().sum(-1).mean().sqrt())
        return HeadCorrespondence(pose, model.vertices, torch.ones(len(vertices), dtype=torch.bool), residual)
    given = None if pairs is None else load_pairs(pairs, head, model)
    meshes = [[mesh.vertices, mesh.faces, _landmarks(mesh)] for mesh in (head, model)]
    face = _face(head)
    key = content_key(_METHOD, meshes=meshes, face=face, given=given)
    parts = read_checkpoint(state, key)
    if parts is None:
        size, expected = extent(head.vertices), extent(model.vertices)
        if not _SMALLEST < size / max(expected, 1e-9) < _LARGEST:
            raise ValueRangeError(
                f"{path}: its head measures {size:.0f} mm from corner to corner, the model's {expected:.0f} mm; scale "
                "it to the size of a head, in Blender for example"
            )
        if given is None and not bool(face[head.faces].all(1).any()):
            raise ValueRangeError(
                f"{path}: found no triangle in its region face, expected those of the face, or no such region"
            )
        bent, pose, known = (
            _by_registration(head, face, model, progress) if given is None else _by_pairs(head, model, *given)
        )
        parts = {"laid": bent.float(), "known": known, **{name: part.double() for name, part in vars(pose).items()}}
        write_checkpoint(state, parts, key)
    pose, bent, known = (
        Similarity(parts["scale"], parts["rotation"], parts["translation"]),
        parts["laid"],
        parts["known"],
    )
    check_scale(float(pose.scale[0]), path)
    rigid = pose.apply(head.vertices.double())[0]
    residual = float((bent.double() - rigid)[known].square().sum(-1).mean().sqrt())
    if pairs is not None and given is not None:
        return HeadCorrespondence(pose, bent, known, residual, f"{len(given[0])} pairs of {pairs.name}")
    how = "registration" if bool(face.all()) else "registration of the region face"
    return HeadCorrespondence(pose, bent, known, residual, how, int(face.sum()))


def has_topology_of(mesh: Mesh, model: Mesh) -> bool:
    """Whether two meshes have the same vertices and triangles."""
    same = mesh.faces.shape == model.faces.shape and len(mesh.vertices) == len(model.vertices)
    return same and bool((mesh.faces.cpu() == model.faces.cpu()).all())


def placed(pose: Similarity, points: Tensor) -> Tensor:
    """Points (t,N,3) moved by one similarity, float32."""
    return (points.double() @ pose.rotation[0].T.double() * pose.scale[0] + pose.translation[0]).to(torch.float32)


def load_pairs(path: Path, head: Mesh, model: Mesh) -> tuple[Tensor, Tensor]:
    """Vertices of a head and where they lie on the model: numbers (L,) and points (L,3).

    Args:
        path: ``.csv`` with the columns ``input`` and ``model``, vertex numbers from 0; or ``.json`` as ``torchface
            pick`` writes it, with the input's mesh for the template and the model's for the scan.
    """
    if path.suffix.lower() == ".json":
        picked = load_correspondences(path)
        picked.check(head)
        ids, points = picked.vertices, picked.points
    elif path.suffix.lower() == ".csv":
        table = TableReader(path)
        table.require(_COLUMNS)
        numbers = torch.from_numpy(table.read(only=_COLUMNS).columns(_COLUMNS).copy())
        if not bool((numbers == numbers.round()).all()):
            raise FileFormatError(f"{path}: found a vertex number that is not whole, expected numbers from 0")
        ids, targets = numbers.long().unbind(1)
        for name, rows, count in (("input", ids, len(head.vertices)), ("model", targets, len(model.vertices))):
            if len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < count:
                raise TopologyError(
                    f"{path}: found vertices {int(rows.min())} to {int(rows.max())} in the column {name}, expected 0 "
                    f"to {count - 1}"
                )
        points = model.vertices[targets]
    else:
        raise FileFormatError(f"{path}: found the ending {path.suffix!r}, expected .csv or .json")
    if len(ids) < LEAST_POINTS:
        raise ShapeError(f"{path}: found {len(ids)} pairs, expected at least {LEAST_POINTS}")
    if len(ids.unique()) < len(ids):
        raise ValueRangeError(f"{path}: found a vertex of the input more than once, expected each in one pair")
    return ids, points.float()


def _face(head: Mesh) -> Tensor:
    """The head's annotated face, (V,) bool, or all of it: hair and teeth would be bent onto the model's skin."""
    return head.regions.get("face", torch.ones(len(head.vertices), dtype=torch.bool))


def _landmarks(mesh: Mesh) -> Tensor | None:
    return None if mesh.annotations is None else mesh.annotations.landmarks


def _by_registration(head: Mesh, face: Tensor, model: Mesh, progress: Progress) -> tuple[Tensor, Similarity, Tensor]:
    """The sparse head's face is bent onto the dense one: that takes seconds, the other way round minutes."""
    part, landmarks = submesh(head, face), None
    marks, sites = _landmarks(head), _landmarks(model)
    if marks is not None and sites is not None and len(marks) == len(sites):
        rows, points = face.cumsum(0) - 1, model.vertices[sites].double()
        points[~face[marks]] = torch.nan  # not on the part that is registered
        if int(face[marks].sum()) >= _FEWEST_LANDMARKS:
            landmarks = rows[marks].clamp(min=0), points

    def report(step: str, done: int = 0, total: int = 0) -> None:
        progress("aligning the input with the model", done, total)

    result = register(part.mesh, model, landmarks, texture_size=0, progress=report)
    bent, known = result.pose.apply(head.vertices.double())[0].float(), torch.zeros_like(face)
    bent[part.vertex_ids] = result.mesh.vertices
    known[part.vertex_ids] = result.matched & (result.distance < _NEAR)
    return bent, result.pose, known


def _by_pairs(head: Mesh, model: Mesh, ids: Tensor, points: Tensor) -> tuple[Tensor, Similarity, Tensor]:
    pose = similarity_transform(head.vertices[ids].double()[None], points.double()[None])
    posed = pose.apply(head.vertices.double())[0]
    offset = points - posed[ids].float()
    bent = posed.float() + ThinShell(posed.float(), head.faces, ids).spread(offset[None])[0]
    distance = SurfaceIndex(model.vertices, model.faces).nearest(bent).distance
    return bent, pose, distance < _NEAR_BY_PAIRS
