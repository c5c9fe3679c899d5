"""Rigid pose of a face in a scan of any pose: hypotheses from noses, refined and judged by nearest points."""

import math
from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.geometry.meshes.operators import components, corners, triangle_areas, triangle_cross
from torchface.geometry.meshes.rigid_icp import Fit, Samples, ScanPoints, fit_of, rigid_icp
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh

_POINTS = 20000
_CRUMB = 0.05  # parts smaller than this share of the largest are left out
_QUERIES = 3000
_CANDIDATES = 40
_NEAR, _FAR = 9.0, 26.0  # millimetres round a point that may be a nose
_APART = 9.0  # millimetres between two such points
_ROLLS = 24  # turns about the nose's direction that are tried
_TILT = 18.0  # degrees that the nose's direction is tilted up, down, left and right, beside as it is
_SURVIVORS = 700, 30  # hypotheses that go on after a first look, and after a first refinement
_FEW, _SOME = 60, 400  # of the face's points: in the first look and refinement, and in the last one
_SLACK = 0.5  # of the first matches, see `rigid_icp`
_REACH = 12.0  # millimetres, of the first look
_FIRST_REACHES = (25.0, 22.0, 19.0, 16.0, 14.0, 12.0)
_REACHES = (25.0, 20.0, 16.0, 12.0, 12.0, 9.0, 9.0, 7.0, 7.0, 6.0, 6.0, 5.0, 5.0, 5.0, 5.0)


def sample_surface(mesh: Mesh) -> ScanPoints:
    """Area-weighted random points with normals on a scan's large connected parts, normals made to point outward.

    Normals that point inward on the whole (a scan turned inside out) are flipped: those of a head point away from the
    middle of its points more often than toward it.
    """
    vertices = mesh.vertices.detach().cpu().double()
    faces = mesh.faces.cpu()
    area = triangle_areas(vertices, faces)
    if len(faces) == 0 or not float(area.sum()) > 0:
        raise ValueRangeError(f"scan: found {len(faces)} triangles without area, expected a surface")
    part = components(faces, len(vertices))[faces[:, 0]]
    part_area = torch.zeros(int(part.max()) + 1, dtype=torch.float64).index_add_(0, part, area)
    area = area * (part_area >= _CRUMB * part_area.max())[part]
    generator = torch.Generator().manual_seed(0)
    pick = torch.searchsorted(
        area.cumsum(0), torch.rand(_POINTS, generator=generator, dtype=torch.float64) * area.sum()
    )
    pick = pick.clamp(max=len(faces) - 1)
    first, second = torch.rand(2, _POINTS, 1, generator=generator, dtype=torch.float64)
    root = first.sqrt()
    a, b, c = corners(vertices, faces[pick])
    points = (1 - root) * a + root * (1 - second) * b + root * second * c
    normals = torch.nn.functional.normalize(triangle_cross(vertices, faces[pick]), dim=-1, eps=1e-20)
    if float(((points - points.mean(0)) * normals).sum(-1).sign().sum()) < 0:
        normals = -normals
    return ScanPoints(points, normals, torch.zeros(_POINTS, dtype=torch.bool))


@dataclass(frozen=True, eq=False)
class NoseCandidates:
    """Points (K,3) on the surface, the way each looks (K,3), best first."""

    points: Tensor
    directions: Tensor


def protrusion(points: Tensor, normals: Tensor, queries: Tensor) -> tuple[Tensor, Tensor]:
    r"""How far each query stands out over its surroundings, (Q,) millimetres, and the unit mean normal near it, (Q,3).

    With the mean normal n of the surface within 9 mm of q, what is measured is the mean of
    :math:`n \cdot (q - p)` over the surface points p between 9 and 26 mm away: nearly 0 on a cheek, 3 mm on a ball of
    a head's size, 10 mm at a nose.

    Args:
        points, normals: the surface, (N,3).
        queries: (Q,3).
    """
    tree, looked = cKDTree(points.numpy()), cKDTree(queries.numpy())
    pairs = looked.sparse_distance_matrix(tree, _FAR, output_type="ndarray")
    row, column = torch.from_numpy(pairs["i"].astype("int64")), torch.from_numpy(pairs["j"].astype("int64"))
    near = torch.from_numpy(pairs["v"].copy()) < _NEAR
    total = torch.zeros_like(queries).index_add_(0, row[near], normals[column[near]])
    direction = torch.nn.functional.normalize(total, dim=-1, eps=1e-20)
    row, column = row[~near], column[~near]
    height = ((queries[row] - points[column]) * direction[row]).sum(-1)
    count = torch.zeros(len(queries), dtype=torch.float64).index_add_(0, row, torch.ones_like(height))
    mean = torch.zeros(len(queries), dtype=torch.float64).index_add_(0, row, height) / count.clamp(min=1)
    return mean, direction


def nose_candidates(surface: ScanPoints) -> NoseCandidates:
    """The points of a scan that stand out most, no two close together; hair, ears and collars are among them."""
    thinned = slice(0, 4 * _QUERIES)
    looked = surface.points[:_QUERIES]
    height, direction = protrusion(surface.points[thinned], surface.normals[thinned], looked)
    order = height.argsort(descending=True)
    looked, direction = looked[order], direction[order]
    # Greedy: which points are left depends on those taken before.
    apart = torch.cdist(looked, looked) > _APART
    free = torch.ones(len(looked), dtype=torch.bool)
    taken: list[int] = []
    while len(taken) < _CANDIDATES and bool(free.any()):
        best = int(free.nonzero()[0, 0])
        taken.append(best)
        free &= apart[best]
    return NoseCandidates(looked[taken], direction[taken])


def hypotheses(nose: Tensor, direction: Tensor, found: NoseCandidates) -> Similarity:
    """Poses that bring a nose at ``nose`` (3,), looking along ``direction`` (3,), onto each candidate, every roll."""
    rotations = []
    base = _frame(direction[None])[0]
    lean = math.radians(_TILT)
    across = _frame(found.directions)
    for axis, angle in ((0, 0.0), (0, lean), (0, -lean), (1, lean), (1, -lean)):
        for k in range(_ROLLS):
            roll_and_tilt = _turn(2 * math.pi * k / _ROLLS, 2) @ _turn(angle, axis)
            rotations.append(across @ roll_and_tilt @ base.T)
    rotation = torch.cat(rotations)
    target = found.points.repeat(len(rotations), 1)
    translation = target - (rotation @ nose)
    return Similarity(torch.ones(len(rotation), dtype=torch.float64), rotation, translation)


def find_pose(face: Samples, nose: Tensor, direction: Tensor, surface: ScanPoints, found: NoseCandidates) -> Fit:
    """The pose of a face in a scan, a batch of one, and how well it fits there; ``found`` is where noses may be.

    The first of the face's points are spread over it; its nose and where it looks are (3,).
    """
    tried = hypotheses(nose, direction, found)
    likely = fit_of(face.first(_FEW), surface, tried, _REACH, _SLACK).argsort(descending=True)
    start = tried[likely[: _SURVIVORS[0]]]
    rough = rigid_icp(face.first(_FEW), surface, start, _FIRST_REACHES, scale=True, slack=_SLACK).best(_SURVIVORS[1])
    return rigid_icp(face.first(_SOME), surface, rough.pose, _REACHES, scale=True).best(1)


def _frame(direction: Tensor) -> Tensor:
    """Rotations (K,3,3) whose third column is ``direction`` (K,3); the others lie anywhere across it."""
    helper = torch.nn.functional.one_hot(direction.abs().argmin(-1), 3).to(direction)
    side = torch.nn.functional.normalize(torch.linalg.cross(helper, direction), dim=-1)
    return torch.stack([side, torch.linalg.cross(direction, side), direction], dim=-1)


def _turn(angle: float, axis: int) -> Tensor:
    vector = torch.zeros(3, dtype=torch.float64)
    vector[axis] = angle
    return rotation_matrix(vector)
