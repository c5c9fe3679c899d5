"""Alignment of a scan with a mesh of the same face: by picked points, or by itself."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import AlignmentError, ShapeError, ValueRangeError
from torchface.geometry.meshes.operators import triangle_areas
from torchface.geometry.meshes.rigid_icp import Samples, ScanPoints, even_rotations, falling_reaches, rigid_icp
from torchface.geometry.meshes.unit_check import check_unit, extent
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.mesh import Mesh
from torchface.number_checks import as_tensor, checked_indices, checked_type
from torchface.registration.scan_preparation import check_same_hand

Correspondences = tuple[Tensor, Tensor]
"""Vertex ids (L,) or points (L,3) of the mesh, and points (L,3) of the scan."""

_SAMPLES, _SOME, _FEW = 3000, 800, 250
_ROTATIONS, _FINALISTS = 150, 4
_REACH = 40.0  # millimetres; what lies further from the scan has no place on it
_NEAR = 3.0  # millimetres; what an expression's scan and its shape differ by at most places
_FIRST_REACHES = falling_reaches(_REACH, 10.0, 12)
_REACHES = falling_reaches(_REACH, _NEAR, 30)
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
    mesh, scan = (one.with_vertices(one.vertices.detach()) for one in (mesh, scan))
    check_unit(
        "scan",
        scan.vertices[scan.faces.flatten()],
        extent(mesh.vertices[mesh.faces.flatten()]),
        "a mesh",
        _LEAST_EXTENT,
        _MOST_EXTENT,
    )
    target = ScanPoints.of(scan.vertices, scan.faces, whole_border=True)
    samples = _samples(mesh)
    if correspondences is None:
        pose = _found_by_itself(samples, target)
    else:
        picked = _picked(mesh, correspondences)
        check_same_hand(*picked, "correspondences")
        pose = similarity_transform(picked[0][None], picked[1][None], scale=scale)
    pose = rigid_icp(samples, target, pose, _REACHES, scale).pose
    found = _nearness(samples, target, pose)
    return ScanAlignment(pose.inverse(), found.distance, found.overlap)


def _picked(mesh: Mesh, correspondences: Correspondences) -> tuple[Tensor, Tensor]:
    on_mesh, on_scan = (as_tensor("correspondences", one, "(L,) or (L,3)").detach() for one in correspondences)
    if on_mesh.ndim == 1:
        name = "correspondences: vertices of the mesh"
        on_mesh = mesh.vertices[checked_indices(name, on_mesh, len(mesh.vertices), ValueRangeError)]
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


def _samples(mesh: Mesh) -> Samples:
    """Vertices drawn evenly by area: they lie on the skin, which bulges out of the triangles between them."""
    vertices = mesh.vertices.double()
    areas = torch.zeros(len(vertices), dtype=torch.float64)
    areas.index_add_(0, mesh.faces.flatten(), triangle_areas(vertices, mesh.faces).repeat_interleave(3))
    chosen = torch.multinomial(areas, _SAMPLES, True, generator=torch.Generator().manual_seed(_SEED))
    return Samples.of(vertices, mesh.faces, chosen)


def _found_by_itself(samples: Samples, target: ScanPoints) -> Similarity:
    """The pose, of the mesh on the scan, that comes nearest: from where it lies, or else from any rotation."""
    one = torch.ones(1, dtype=torch.float64)
    still = Similarity(one, torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))
    pose = rigid_icp(samples.first(_SOME), target, still, _REACHES).pose
    if _nearness(samples, target, pose).near >= _MIN_NEAR:
        return pose
    rotations = even_rotations(_ROTATIONS)
    middles = target.points.mean(0) - rotations @ samples.points.mean(0)
    starts = Similarity(one.expand(len(rotations)), rotations, middles)
    coarse = rigid_icp(samples.first(_FEW), target, starts, _FIRST_REACHES, slack=0.5).best(_FINALISTS)
    poses = rigid_icp(samples.first(_SOME), target, coarse.pose, _REACHES).pose
    found = [_nearness(samples, target, poses[row : row + 1]) for row in range(_FINALISTS)]
    row = max(range(_FINALISTS), key=lambda row: found[row].near * found[row].overlap)
    if found[row].near < _MIN_NEAR or found[row].overlap < _MIN_OVERLAP:
        raise AlignmentError(
            f"scan: no pose found by itself that aligns it with the mesh (best: {found[row].near:.0%} of the overlap "
            f"within {_NEAR:g} mm); expected scan and mesh of one face in one expression, triangles counter-clockwise "
            "seen from outside, or at least three correspondences"
        )
    return poses[row : row + 1]


@dataclass(frozen=True)
class _Nearness:
    """Of samples that have a place on a scan and agree with it: the median distance, the share that have one, and the
    share of these that come near."""

    distance: float
    overlap: float
    near: float


def _nearness(samples: Samples, target: ScanPoints, pose: Similarity) -> _Nearness:
    points, normals = pose.apply(samples.points)[0], samples.normals @ pose.rotation[0].T
    distance, row = target.nearest(points)
    # A sample whose nearest point is on the scan's border lies beyond it.
    placed = (distance < _REACH) & ~target.border[row]
    agree = placed & ((normals * target.normals[row]).sum(-1) > 0.5)
    if not bool(agree.any()):
        return _Nearness(float("inf"), 0.0, 0.0)
    offset = ((points - target.points[row]) * target.normals[row]).sum(-1).abs()[agree]
    near = float((offset < _NEAR).sum()) / int(placed.sum())
    return _Nearness(float(offset.median()), len(offset) / len(points), near)
