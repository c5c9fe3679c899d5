"""Alignment of a scan with a mesh of the same face: by picked points, or by itself."""

from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchface.errors import AlignmentError, ShapeError, ValueRangeError
from torchface.geometry.meshes.operators import border_vertices, triangle_areas, vertex_normals
from torchface.geometry.meshes.unit_check import check_unit, extent
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.mesh import Mesh
from torchface.number_checks import checked_type
from torchface.registration.scan_preparation import check_same_hand

Correspondences = tuple[Tensor, Tensor]
"""Vertex ids (L,) or points (L,3) of the mesh, and points (L,3) of the scan."""

_SAMPLES, _COARSE_SAMPLES = 3000, 400
_COARSE_POINTS = 10_000
_REACH = 40.0  # millimetres; no partner is sought beyond
_NEAR = 3.0  # millimetres; what an expression's scan and its shape differ by at most places
_MIN_NEAR = 0.6  # share of the samples with a place on the scan that must come to lie near it
_MIN_OVERLAP = 0.1
_LEAST_EXTENT, _MOST_EXTENT = 0.12, 12.0  # of a scan beside the mesh: faces differ by a factor of some, units by ten
_SEED = 0


@dataclass(frozen=True, eq=False)
class ScanAlignment:
    """The alignment of a scan with a mesh.

    Args:
        similarity: scan space to mesh space, a batch of one.
        median_distance: of points of the mesh to the scan where they overlap, millimetres.
        overlap: share of the mesh that has a place on the scan.
    """

    similarity: Similarity
    median_distance: float
    overlap: float


def align_scan(
    mesh: Mesh, scan: Mesh, correspondences: Correspondences | None = None, scale: bool = False
) -> ScanAlignment:
    """Aligns a scan to a mesh of the same face by iterated closest points, trimmed to where they overlap.

    The initial pose comes from the correspondences; without them the scan may lie in any pose, and whichever of many
    initial poses ends closest is taken. A scan that shows less than a tenth of the mesh needs picked points.

    Args:
        mesh: the face.
        scan: the same face, millimetres, all of it or a part.
        correspondences: at least three, see ``Correspondences``; closest points follow, so picks may be wrong by some
            millimetres.
        scale: estimate the scan's scale too.

    Raises:
        ShapeError: fewer than three correspondences, or not of the shapes above.
        ValueRangeError: a correspondence is NaN, on a line, or the scan is in another unit.
        AlignmentError: no initial pose ends close enough, or the correspondences are mirrored.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> ids = head.landmarks[::8]
        >>> aligned = align_scan(head, head.with_vertices(head.vertices + 30.0), (ids, head.vertices[ids] + 30.0))
        >>> aligned.similarity.translation.round().tolist()
        [[-30.0, -30.0, -30.0]]
    """
    for name, one in (("mesh", mesh), ("scan", scan)):
        checked_type(name, one, Mesh)
    check_unit(
        "scan",
        scan.vertices[scan.faces.flatten()],
        extent(mesh.vertices[mesh.faces.flatten()]),
        "a mesh",
        _LEAST_EXTENT,
        _MOST_EXTENT,
    )
    target = _Target.of(scan)
    if correspondences is not None:
        picked = _picked(mesh, correspondences)
        check_same_hand(*picked, "correspondences")
        initial = similarity_transform(picked[0][None], picked[1][None], scale=scale)
        return _result(_iterate(_samples(mesh, _SAMPLES), target, _Pose.of(initial), 40, scale))
    return _automatic(mesh, target, scale)


def _picked(mesh: Mesh, correspondences: Correspondences) -> tuple[Tensor, Tensor]:
    on_mesh, on_scan = correspondences
    if on_mesh.ndim == 1 and on_mesh.dtype == torch.int64:
        if len(on_mesh) and not 0 <= int(on_mesh.min()) <= int(on_mesh.max()) < len(mesh.vertices):
            raise ValueRangeError(
                f"correspondences: found mesh vertices {int(on_mesh.min())} to {int(on_mesh.max())}, "
                f"expected 0 to {len(mesh.vertices) - 1}"
            )
        on_mesh = mesh.vertices[on_mesh]
    shapes = f"{tuple(on_mesh.shape)} and {tuple(on_scan.shape)}"
    if on_mesh.shape != on_scan.shape or on_mesh.ndim != 2 or on_mesh.shape[1] != 3:
        raise ShapeError(f"correspondences: found {shapes}, expected vertex ids (L,) or points (L,3), and points (L,3)")
    if len(on_mesh) < 3:
        raise ShapeError(f"correspondences: found {len(on_mesh)}, expected at least 3")
    for name, points in (("mesh", on_mesh), ("scan", on_scan)):
        if not torch.isfinite(points).all():
            raise ValueRangeError(f"correspondences: found NaN or infinite points on the {name}, expected none")
        singular = torch.linalg.svdvals(points.double() - points.double().mean(0))
        if float(singular[1]) < 1e-3 * float(singular[0]) or float(singular[0]) == 0:
            raise ValueRangeError(
                f"correspondences: the points on the {name} lie on a line, expected a triangle of them"
            )
    return on_mesh.double(), on_scan.double()


@dataclass(frozen=True, eq=False)
class _Target:
    points: Tensor
    normals: Tensor
    border: Tensor
    tree: cKDTree

    @staticmethod
    def of(scan: Mesh) -> "_Target":
        vertices = scan.vertices.double()
        normals = vertex_normals(vertices, scan.faces)
        used = normals.norm(dim=1) > 0.5  # loose vertices and those of triangles without area have no normal
        points = vertices[used]
        return _Target(points, normals[used], border_vertices(scan.faces, len(vertices))[used], cKDTree(points.numpy()))

    def thinned(self, count: int) -> "_Target":
        """Fewer points, but the whole border, so that points beyond it are still recognised."""
        keep = torch.randperm(len(self.points), generator=torch.Generator().manual_seed(_SEED))[:count]
        keep = torch.cat([keep, self.border.nonzero()[:, 0]]).unique()
        points = self.points[keep]
        return _Target(points, self.normals[keep], self.border[keep], cKDTree(points.numpy()))


@dataclass(frozen=True, eq=False)
class _Samples:
    points: Tensor
    normals: Tensor

    def first(self, count: int) -> "_Samples":
        return _Samples(self.points[:count], self.normals[:count])


def _samples(mesh: Mesh, count: int) -> _Samples:
    """Vertices drawn evenly by area: they lie on the skin, which bulges out of the triangles between them."""
    vertices = mesh.vertices.double()
    areas = torch.zeros(len(vertices), dtype=torch.float64)
    areas.index_add_(0, mesh.faces.flatten(), triangle_areas(vertices, mesh.faces).repeat_interleave(3))
    chosen = torch.multinomial(areas, count, True, generator=torch.Generator().manual_seed(_SEED))
    return _Samples(vertices[chosen], vertex_normals(vertices, mesh.faces)[chosen])


@dataclass(frozen=True, eq=False)
class _Pose:
    """Mesh to scan, with how well it fits."""

    scale: Tensor
    rotation: Tensor
    translation: Tensor
    distance: float = float("inf")
    overlap: float = 0.0
    near: float = 0.0

    @staticmethod
    def of(similarity: Similarity) -> "_Pose":
        one = similarity
        return _Pose(one.scale[0].double(), one.rotation[0].double(), one.translation[0].double())


def _automatic(mesh: Mesh, target: _Target, scale: bool) -> ScanAlignment:
    samples = _samples(mesh, _SAMPLES)
    identity = _Pose(torch.ones(()).double(), torch.eye(3).double(), torch.zeros(3).double())
    best = _iterate(samples, target, identity, 40, False)
    if best.near < _MIN_NEAR:
        few, thin = samples.first(_COARSE_SAMPLES), target.thinned(_COARSE_POINTS)
        # Each initial pose is iterated by itself; four hundred points against a thinned scan take milliseconds.
        coarse = [_iterate(few, thin, initial, 15, False) for initial in _initial_poses(samples, target)]
        coarse.sort(key=lambda pose: -pose.near * pose.overlap)
        best = max(
            (_iterate(samples, target, pose, 40, False) for pose in coarse[:4]), key=lambda p: p.near * p.overlap
        )
    if best.near < _MIN_NEAR or best.overlap < _MIN_OVERLAP:
        raise AlignmentError(
            f"scan: no pose found by itself that aligns it with the mesh (best: {best.near:.0%} of the overlap within "
            f"{_NEAR:g} mm); expected scan and mesh of one face in one expression, triangles counter-clockwise seen "
            "from outside, or at least three correspondences"
        )
    return _result(_iterate(samples, target, best, 40, scale) if scale else best)


def _initial_poses(samples: _Samples, target: _Target) -> list[_Pose]:
    """Centre on centre, rotated to each of the 24 poses of a cube and each half-way to its neighbours."""
    one = torch.ones(()).double()
    middle, other = samples.points.mean(0), target.points.mean(0)
    cube = Rotation.create_group("O")
    rotations = torch.from_numpy(
        Rotation.concatenate([cube, Rotation.from_euler("xyz", [45, 35, 0], True) * cube]).as_matrix()
    )
    return [_Pose(one, rotation, other - rotation @ middle) for rotation in rotations]


def _iterate(samples: _Samples, target: _Target, pose: _Pose, iterations: int, scale: bool) -> _Pose:
    """Point to plane, each iteration on the pairs that agree, found in the pose of the one before."""
    s, rotation, translation, reach = pose.scale, pose.rotation, pose.translation, _REACH
    for _ in range(iterations):
        points = s * samples.points @ rotation.T + translation
        pairs = _pairs(points, samples.normals @ rotation.T, target, reach)
        if len(pairs.rows) < 12:
            break
        step = _step(points[pairs.rows], target.points[pairs.nearest], target.normals[pairs.nearest], scale)
        s, rotation, translation = s * step.scale, step.rotation @ rotation, step.apply(translation)
        reach = min(_REACH, 6 * pairs.median + 2 * _NEAR)
        if step.motion < 1e-3:
            break
    points = s * samples.points @ rotation.T + translation
    pairs = _pairs(points, samples.normals @ rotation.T, target, _REACH)
    if len(pairs.rows) == 0:
        return _Pose(s, rotation, translation)
    offset = ((points[pairs.rows] - target.points[pairs.nearest]) * target.normals[pairs.nearest]).sum(1).abs()
    near = float((offset < _NEAR).sum()) / pairs.placed
    return _Pose(s, rotation, translation, float(offset.median()), len(offset) / len(points), near)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Samples ``rows`` that agree with scan vertices ``nearest``, their median distance, and how many have a place."""

    rows: Tensor
    nearest: Tensor
    median: float
    placed: int


def _pairs(points: Tensor, normals: Tensor, target: _Target, reach: float) -> _Pairs:
    workers = 1 if len(points) <= _COARSE_SAMPLES else -1
    neighbours = target.tree.query(points.numpy(), distance_upper_bound=reach, workers=workers)
    distance, nearest = torch.from_numpy(neighbours[0]), torch.from_numpy(neighbours[1])
    rows = torch.isfinite(distance).nonzero()[:, 0]
    # A sample whose nearest point is on the scan's border lies beyond it.
    rows = rows[~target.border[nearest[rows]]]
    placed = len(rows)
    rows = rows[(normals[rows] * target.normals[nearest[rows]]).sum(1) > 0.5]
    if len(rows) == 0:
        return _Pairs(rows, rows, 0.0, placed)
    median = float(distance[rows].median())
    rows = rows[distance[rows] <= 2.5 * median + 1e-6]
    return _Pairs(rows, nearest[rows], median, placed)


@dataclass(frozen=True, eq=False)
class _Step:
    scale: Tensor
    rotation: Tensor
    centre: Tensor
    translation: Tensor
    motion: float

    def apply(self, point: Tensor) -> Tensor:
        return self.scale * self.rotation @ (point - self.centre) + self.centre + self.translation


def _step(points: Tensor, targets: Tensor, normals: Tensor, scale: bool) -> _Step:
    """The small motion that brings points onto the planes of their targets, in least squares."""
    centre = points.mean(0)
    offset = points - centre
    reach = offset.norm(dim=1).mean()
    columns = [torch.linalg.cross(offset, normals) / reach, normals]
    if scale:
        columns.append((offset * normals).sum(1, keepdim=True) / reach)
    system = torch.cat(columns, dim=1)
    right = ((targets - points) * normals).sum(1, keepdim=True)
    # A little damping keeps still what the surface leaves open, such as the rotation of a ball.
    gram = system.T @ system + 1e-6 * len(points) * torch.eye(system.shape[1], dtype=torch.float64)
    x = torch.linalg.solve(gram, system.T @ right)[:, 0]
    rotation = torch.from_numpy(Rotation.from_rotvec((x[:3] / reach).numpy()).as_matrix())
    grown = 1 + x[6] / reach if scale else torch.ones(()).double()
    return _Step(grown, rotation, centre, x[3:6], float(x.norm()))


def _result(pose: _Pose) -> ScanAlignment:
    mesh_to_scan = Similarity(pose.scale[None], pose.rotation[None], pose.translation[None])
    return ScanAlignment(mesh_to_scan.inverse(), pose.distance, pose.overlap)
