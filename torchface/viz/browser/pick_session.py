"""Picks on a mesh and a scan, without a page: clicks as rays, mirrored picks, undo."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.attachment import Attachment
from torchface.errors import AlignmentError, NameMismatchError, ValueRangeError
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.meshes.unit_check import extent
from torchface.io.landmarks.picks import Correspondences, LandmarkVertices, load_correspondences, load_landmarks
from torchface.mesh import Mesh
from torchface.rendering.raycast import RayCaster
from torchface.viz.browser.landmark_sets import IBUG_68, LandmarkSet

_MIDLINE = 1.0
# Of the extent: a face is not this far from its mirror image, a head that is turned is.
_FAR, _ITERATIONS, _ON_SCAN = 0.03, 10, 1e-4


@dataclass(frozen=True)
class SurfacePoint:
    """A point on a mesh: triangle, barycentric coordinates, position in millimetres, nearest corner's vertex id."""

    triangle: int
    barycentric: tuple[float, float, float]
    position: tuple[float, float, float]
    vertex: int


@dataclass(frozen=True)
class Picks:
    """All that is picked at one moment."""

    landmarks: tuple[int | None, ...] = ()  # vertex ids in the set's order, nothing where not picked yet
    markers: tuple[tuple[str, SurfacePoint], ...] = ()
    # label, template vertex, scan point in the scan's space
    pairs: tuple[tuple[str, int, tuple[float, float, float]], ...] = ()
    waiting: int | None = None  # the template vertex whose scan point is still to come


class PickSession:
    """Picks in the making; landmarks that the mesh brings, as many as the set has, are picked already.

    Every change can be undone, one step a click.
    """

    def __init__(self, mesh: Mesh, scan: Mesh | None = None, landmark_set: LandmarkSet = IBUG_68) -> None:
        self.mesh, self.scan, self.landmark_set = mesh.to("cpu"), None if scan is None else scan.to("cpu"), landmark_set
        self._mesh_caster = RayCaster(self.mesh.vertices, self.mesh.faces)
        self._scan_caster = None if self.scan is None else RayCaster(self.scan.vertices, self.scan.faces)
        given = None if mesh.annotations is None else mesh.annotations.landmarks
        count = len(landmark_set.names)
        initial = (None,) * count if given is None or len(given) != count else tuple(given.tolist())
        self._history = [Picks(landmarks=initial)]

    def resume(self, folder: Path) -> None:
        """Goes on with what an earlier session saved in a folder; markers and pairs can be taken back one by one."""
        mesh, names, picks = self.mesh, self.landmark_set.names, self.picks
        if (path := folder / "landmarks.json").is_file():
            saved = load_landmarks(path)
            saved.check(mesh)
            given = dict(zip(saved.labels, saved.vertices.tolist(), strict=True))
            if others := [name for name in given if name not in names]:
                raise NameMismatchError(f"{path}: found {others[0]!r}, expected {names[0]!r}, ...; give another --out")
            landmarks = tuple(given.get(name, old) for name, old in zip(names, picks.landmarks, strict=True))
            self._history = [replace(picks, landmarks=landmarks)]
        if (path := folder / "attachment.json").is_file():
            sites = Attachment.load(path)
            sites.check(mesh, path)
            sited = zip(sites.labels or (), sites.triangles.tolist(), sites.barycentric, strict=False)
            for label, triangle, weights in sited:
                self.pick_marker(_surface_point(mesh, triangle, weights), label)
        if self.scan is not None and (path := folder / "correspondences.json").is_file():
            pairs = load_correspondences(path)
            pairs.check(mesh)
            far = float(SurfaceIndex(self.scan.vertices, self.scan.faces).nearest(pairs.points).distance.max())
            if far > _ON_SCAN * extent(self.scan.vertices):
                raise AlignmentError(
                    f"{path}: found pairs {far:.3g} mm off the scan, expected its own; give another --out"
                )
            points = map(tuple, pairs.points.tolist())
            for pair in zip(pairs.labels, pairs.vertices.tolist(), points, strict=True):
                self._history.append(replace(self.picks, pairs=(*self.picks.pairs, pair)))

    @property
    def picks(self) -> Picks:
        """As they stand."""
        return self._history[-1]

    def undo(self) -> bool:
        """Takes the last step back; false where there is none."""
        return len(self._history) > 1 and self._history.pop() is not None

    @property
    def next_landmark(self) -> int | None:
        """The first landmark not picked yet."""
        return next((row for row, vertex in enumerate(self.picks.landmarks) if vertex is None), None)

    def on_mesh(self, origin: Tensor, direction: Tensor) -> SurfacePoint | None:
        """Where a ray, origin (3,) and direction (3,), first meets the mesh."""
        return _first_hit(self._mesh_caster, self.mesh, origin, direction)

    def on_scan(self, origin: Tensor, direction: Tensor) -> SurfacePoint | None:
        """Where a ray first meets the scan, in the scan's space."""
        if self.scan is None or self._scan_caster is None:
            return None
        return _first_hit(self._scan_caster, self.scan, origin, direction)

    def pick_landmark(self, point: SurfacePoint, mirrored: bool = False, row: int | None = None) -> int:
        """Sets landmark ``row``, the next one if absent, to the vertex; mirrored its twin too. Returns the row."""
        row = self.next_landmark if row is None else row
        if row is None:
            raise ValueRangeError(f"landmarks: all {len(self.picks.landmarks)} are picked; choose one to move")
        landmarks = list(self.picks.landmarks)
        landmarks[row] = point.vertex
        twin = self.landmark_set.mirror[row]
        if mirrored and twin != row:
            landmarks[twin] = self.mirror_point(point).vertex
        self._history.append(replace(self.picks, landmarks=tuple(landmarks)))
        return row

    def pick_marker(self, point: SurfacePoint, label: str | None = None, mirrored: bool = False) -> tuple[str, ...]:
        """Adds a marker site; mirrored also its mirror image, unless the two would lie within a millimetre.

        Without a label they are called ``marker000`` and on. Returns the labels.
        """
        places = [point]
        if mirrored:
            image = self.mirror_point(point)
            if torch.tensor(image.position).dist(torch.tensor(point.position)) > 2 * _MIDLINE:
                places.append(image)
        markers = self.picks.markers
        labels = self._marker_labels(label, len(places))
        self._history.append(replace(self.picks, markers=(*markers, *zip(labels, places, strict=True))))
        return labels

    def pick_template(self, point: SurfacePoint) -> None:
        """Begins a pair at the nearest template vertex, or moves the beginning of one that waits."""
        self._history.append(replace(self.picks, waiting=point.vertex))

    def pick_scan(self, point: SurfacePoint) -> str:
        """Ends the pair that waits; returns its label."""
        picks = self.picks
        if picks.waiting is None:
            raise ValueRangeError("correspondences: found a point on the scan first, expected one on the template")
        taken = {label for label, _, _ in picks.pairs}
        label = next(name for i in range(len(taken) + 1) if (name := f"pair{i:03d}") not in taken)
        pairs = (*(pair for pair in picks.pairs if pair[1] != picks.waiting), (label, picks.waiting, point.position))
        self._history.append(replace(picks, pairs=pairs, waiting=None))
        return label

    def mirror_point(self, point: SurfacePoint) -> SurfacePoint:
        """The mirror image of a surface point, on the surface: as annotated, else nearest to (2m-x, y, z)."""
        mirror = None if self.mesh.annotations is None else self.mesh.annotations.mirror
        if mirror is not None:
            corners = mirror[self.mesh.faces[point.triangle]]
            image = torch.tensor(point.barycentric, dtype=torch.float64) @ self.mesh.vertices[corners].double()
        else:
            x, y, z = point.position
            image = torch.tensor([2 * self._middle - x, y, z], dtype=torch.float64)
        nearest = self._index.nearest(image[None])
        if float(nearest.distance[0]) > _FAR * extent(self.mesh.vertices):
            raise ValueRangeError(
                f"mirrored: found the surface {float(nearest.distance[0]):.3g} mm from the mirror image about "
                f"x = {self._middle:.3g} mm, expected a head that looks along z; pick each side by itself"
            )
        return _surface_point(self.mesh, int(nearest.triangle[0]), nearest.barycentric[0])

    @cached_property
    def _middle(self) -> float:
        """Of the vertices along x: half-way, in the median, between each and the one nearest to its mirror image."""
        points = self.mesh.vertices.double()
        tree, middle = cKDTree(points.numpy()), float(points[:, 0].amin() + points[:, 0].amax()) / 2
        for _ in range(_ITERATIONS):
            images = points * points.new_tensor([-1, 1, 1]) + points.new_tensor([2 * middle, 0, 0])
            middle = float((points[:, 0] + points[tree.query(images.numpy())[1], 0]).median()) / 2
        return middle

    def landmarks(self) -> LandmarkVertices:
        """The landmarks picked so far."""
        rows = [row for row, vertex in enumerate(self.picks.landmarks) if vertex is not None]
        ids = torch.tensor([self.picks.landmarks[row] for row in rows], dtype=torch.int64)
        return LandmarkVertices(ids, tuple(self.landmark_set.names[row] for row in rows), self.mesh.fingerprint())

    def attachment(self) -> Attachment:
        """The marker sites."""
        triangles = torch.tensor([point.triangle for _, point in self.picks.markers], dtype=torch.int64)
        barycentric = torch.tensor([point.barycentric for _, point in self.picks.markers])
        labels = tuple(label for label, _ in self.picks.markers)
        return Attachment(triangles, barycentric, labels).made_for(self.mesh)

    def correspondences(self) -> Correspondences:
        """The complete pairs."""
        labels, vertices, points = zip(*self.picks.pairs, strict=True)
        values = torch.tensor(points, dtype=torch.float64)
        return Correspondences(torch.tensor(vertices), values, tuple(labels), self.mesh.fingerprint())

    def _marker_labels(self, label: str | None, count: int) -> tuple[str, ...]:
        taken = {name for name, _ in self.picks.markers}
        if label:
            labels = (label,) if count == 1 else (label, f"{label}_mirrored")
            if taken & set(labels):
                raise ValueRangeError(f"markers: found the label {label!r} twice, expected each once")
            return labels
        free: Callable[[], str] = iter(n for i in range(10**6) if (n := f"marker{i:03d}") not in taken).__next__
        return tuple(free() for _ in range(count))

    @cached_property
    def _index(self) -> SurfaceIndex:
        return SurfaceIndex(self.mesh.vertices, self.mesh.faces)


def _first_hit(caster: RayCaster, mesh: Mesh, origin: Tensor, direction: Tensor) -> SurfacePoint | None:
    if not (torch.isfinite(origin).all() and torch.isfinite(direction).all() and direction.any()):
        raise ValueRangeError(f"click: found a ray {origin.tolist()}, {direction.tolist()}, expected a finite one")
    unit = torch.nn.functional.normalize(direction.double(), dim=0)
    hits = caster.cast(origin.double()[None], unit[None])
    triangle = int(hits.triangle[0])
    return None if triangle < 0 else _surface_point(mesh, triangle, hits.barycentric[0])


def _surface_point(mesh: Mesh, triangle: int, barycentric: Tensor) -> SurfacePoint:
    weights = barycentric.double().clamp(min=0)
    weights = weights / weights.sum()
    corners = mesh.vertices[mesh.faces[triangle]].double()
    position = weights @ corners
    nearest = int((corners - position).norm(dim=1).argmin())
    a, b, c = weights.tolist()
    x, y, z = position.tolist()
    return SurfacePoint(triangle, (a, b, c), (x, y, z), int(mesh.faces[triangle, nearest]))
