"""Picks on a mesh and a scan, without a page: clicks as rays, mirrored picks, undo."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.attachment import Attachment
from torchface.errors import ValueRangeError
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.io.landmarks.picks import Correspondences, LandmarkVertices
from torchface.mesh import Mesh
from torchface.rendering.raycast import RayCaster
from torchface.viz.browser.landmark_sets import IBUG_68, LandmarkSet

_MIDLINE = 1.0


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
        given = None if mesh.annotations is None else mesh.annotations.landmarks
        count = len(landmark_set.names)
        initial = (None,) * count if given is None or len(given) != count else tuple(given.tolist())
        self._history = [Picks(landmarks=initial)]

    @property
    def picks(self) -> Picks:
        """As they stand."""
        return self._history[-1]

    @property
    def steps(self) -> int:
        """How many can be undone."""
        return len(self._history) - 1

    def undo(self) -> bool:
        """Takes the last step back; false where there is none."""
        if self.steps:
            self._history.pop()
            return True
        return False

    @property
    def next_landmark(self) -> int | None:
        """The first landmark not picked yet."""
        return next((row for row, vertex in enumerate(self.picks.landmarks) if vertex is None), None)

    def on_mesh(self, origin: Tensor, direction: Tensor) -> SurfacePoint | None:
        """Where a ray, origin (3,) and direction (3,), first meets the mesh."""
        return _first_hit(self._mesh_caster, self.mesh, origin, direction)

    def on_scan(self, origin: Tensor, direction: Tensor) -> SurfacePoint | None:
        """Where a ray first meets the scan, in the scan's space."""
        return None if self.scan is None else _first_hit(self._scan_caster, self.scan, origin, direction)

    def pick_landmark(self, point: SurfacePoint, mirrored: bool = False, row: int | None = None) -> int:
        """Sets landmark ``row``, the next one if absent, to the vertex; mirrored its twin too. Returns the row."""
        row = self.next_landmark if row is None else row
        if row is None:
            raise ValueRangeError(f"landmarks: all {len(self.picks.landmarks)} are picked; choose one to move")
        landmarks = list(self.picks.landmarks)
        landmarks[row] = point.vertex
        twin = self.landmark_set.mirror[row]
        if mirrored and twin != row:
            landmarks[twin] = int(self.mirror[point.vertex])
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

    @cached_property
    def mirror(self) -> Tensor:
        """The vertex on the other side (V,): as annotated, else the one nearest to (-x, y, z)."""
        if self.mesh.annotations is not None and self.mesh.annotations.mirror is not None:
            return self.mesh.annotations.mirror
        points = self.mesh.vertices.double()
        nearest = cKDTree(points.numpy()).query((points * points.new_tensor([-1, 1, 1])).numpy())[1]
        return torch.from_numpy(nearest).long()

    def mirror_point(self, point: SurfacePoint) -> SurfacePoint:
        """The mirror image of a surface point, on the surface."""
        if self.mesh.annotations is not None and self.mesh.annotations.mirror is not None:
            corners = self.mirror[self.mesh.faces[point.triangle]]
            image = torch.tensor(point.barycentric, dtype=torch.float64) @ self.mesh.vertices[corners].double()
        else:
            image = torch.tensor(point.position, dtype=torch.float64) * torch.tensor([-1.0, 1.0, 1.0])
        nearest = self._index.nearest(image[None])
        return _surface_point(self.mesh, int(nearest.triangle[0]), nearest.barycentric[0])

    def landmarks(self) -> LandmarkVertices:
        """The landmarks picked so far."""
        rows = [row for row, vertex in enumerate(self.picks.landmarks) if vertex is not None]
        _need(rows, "landmark")
        ids = torch.tensor([self.picks.landmarks[row] for row in rows], dtype=torch.int64)
        return LandmarkVertices(ids, tuple(self.landmark_set.names[row] for row in rows), self.mesh.fingerprint())

    def attachment(self) -> Attachment:
        """The marker sites."""
        _need(self.picks.markers, "marker")
        triangles = torch.tensor([point.triangle for _, point in self.picks.markers], dtype=torch.int64)
        barycentric = torch.tensor([point.barycentric for _, point in self.picks.markers])
        labels = tuple(label for label, _ in self.picks.markers)
        return Attachment(triangles, barycentric, labels).made_for(self.mesh)

    def correspondences(self) -> Correspondences:
        """The complete pairs."""
        _need(self.picks.pairs, "correspondence")
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
    def _mesh_caster(self) -> RayCaster:
        return RayCaster(self.mesh.vertices, self.mesh.faces)

    @cached_property
    def _scan_caster(self) -> RayCaster:
        assert self.scan is not None
        return RayCaster(self.scan.vertices, self.scan.faces)

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


def _need(picked: object, what: str) -> None:
    if not picked:
        raise ValueRangeError(f"{what}s: found none picked, expected at least one")
