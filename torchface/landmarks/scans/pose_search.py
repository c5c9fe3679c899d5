"""Rigid pose of a known surface in a scan of any pose: hypotheses from noses, judged and refined by nearest points."""

import math
from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import Similarity
from torchface.landmarks.scans.surface_sample import SurfaceSample

_QUERIES = 3000
_CANDIDATES = 40
_REACH = 12.0  # millimetres; what is further away is as wrong as it gets
_NEAR, _FAR = 9.0, 26.0  # millimetres round a point that may be a nose
_APART = 9.0  # millimetres between two such points
_FACING = 0.5  # cosine of the angle between normals beyond which points do not match
_ROLLS = 24  # turns about the nose's direction that are tried
_TILT = 18.0  # degrees that the nose's direction is tilted up, down, left and right, beside as it is
_SURVIVORS = 700, 30  # hypotheses that go on after a first look, and after a first refinement
# How far a point's match may lie in each round of the first refinement, and of the last one, millimetres.
_FIRST_REACHES = (25.0, 22.0, 19.0, 16.0, 14.0, 12.0)
_REACHES = (25.0, 20.0, 16.0, 12.0, 12.0, 9.0, 9.0, 7.0, 7.0, 6.0, 6.0, 5.0, 5.0, 5.0, 5.0)
_LARGEST_SCALE = 1.2  # the head may be this many times larger or smaller than the mean


@dataclass(frozen=True, eq=False)
class NoseCandidates:
    """Points (K,3) on the surface, the way each looks (K,3), best first."""

    points: Tensor
    directions: Tensor


def protrusion(points: Tensor, normals: Tensor, queries: Tensor) -> tuple[Tensor, Tensor]:
    r"""How far each query stands out over its surroundings, and the mean normal near it.

    With the mean normal n of the surface within 9 mm of q, what is measured is the mean of
    :math:`n \cdot (q - p)` over the surface points p between 9 and 26 mm away: nearly 0 on a cheek, 3 mm on a ball of
    a head's size, 10 mm at a nose.

    Args:
        points, normals: the surface, (N,3).
        queries: (Q,3).

    Returns:
        Heights (Q,) in millimetres and unit directions (Q,3).
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


def nose_candidates(surface: SurfaceSample) -> NoseCandidates:
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


def misfit(poses: Similarity, points: Tensor, normals: Tensor, surface: SurfaceSample) -> Tensor:
    """Mean distance (B,) of moved points from a surface, millimetres; one that is far or faces away counts 12."""
    moved, turned = poses.apply(points), normals @ poses.rotation.transpose(-1, -2)
    distance, row = surface.nearest(moved, _REACH)
    facing = (surface.normals[row] * turned).sum(-1) > _FACING
    return torch.where(facing, distance.clamp(max=_REACH), _REACH).mean(-1)


def refine(
    poses: Similarity, points: Tensor, normals: Tensor, surface: SurfaceSample, reaches: tuple[float, ...]
) -> Similarity:
    r"""Similarity ICP, point to plane, for a batch of poses.

    .. math:: \min_{\omega, t, \sigma} \sum_i \rho_i
        \big(n_i \cdot ((1+\sigma) x_i + \omega \times x_i + t - y_i)\big)^2

    with y the nearest surface points, n their normals, :math:`\rho` Tukey's weight within the round's reach and 0
    where normals disagree.
    """
    eye = torch.eye(7, dtype=torch.float64)
    for reach in reaches:  # each round starts where the last one ended
        moved, turned = poses.apply(points), normals @ poses.rotation.transpose(-1, -2)
        distance, row = surface.nearest(moved, reach)
        n, y = surface.normals[row], surface.points[row]
        centre = moved.mean(1, keepdim=True)
        arm = moved - centre
        weight = (1 - (distance / reach).clamp(max=1) ** 2) ** 2 * ((n * turned).sum(-1) > _FACING)
        columns = torch.cat([torch.linalg.cross(arm, n), n, (arm * n).sum(-1, keepdim=True)], dim=-1)
        residual = ((y - moved) * n).sum(-1)
        weighted = columns * weight[..., None]
        # A little ridge: a pose that no point supports stays where it is.
        normal_matrix = weighted.transpose(-1, -2) @ columns + 1e-3 * eye
        step = torch.linalg.solve(normal_matrix, (weighted * residual[..., None]).sum(1))
        scale = (poses.scale * (1 + step[:, 6].clamp(-0.1, 0.1))).clamp(1 / _LARGEST_SCALE, _LARGEST_SCALE)
        poses = poses.moved(step[:, :3].clamp(-0.3, 0.3), scale / poses.scale, step[:, 3:6], centre[:, 0])
    return poses


def find_pose(
    points: Tensor, normals: Tensor, nose: Tensor, direction: Tensor, surface: SurfaceSample, found: NoseCandidates
) -> tuple[Similarity, float]:
    """The pose of points (N,3) with normals (N,3) in a scan, and its misfit in millimetres.

    Args:
        nose, direction: the face's nose and where it looks, each (3,).
        found: where noses may be on it.
    """
    tried = hypotheses(nose, direction, found)
    few = slice(None, None, max(1, len(points) // 60))
    some = slice(None, None, max(1, len(points) // 400))
    rough = misfit(tried, points[few], normals[few], surface)
    tried = tried[rough.argsort()[: _SURVIVORS[0]]]
    tried = refine(tried, points[few], normals[few], surface, _FIRST_REACHES)
    score = misfit(tried, points[few], normals[few], surface)
    tried = tried[score.argsort()[: _SURVIVORS[1]]]
    tried = refine(tried, points[some], normals[some], surface, _REACHES)
    score = misfit(tried, points[some], normals[some], surface)
    winner = score.argmin()[None]
    return tried[winner], float(score[winner])


def _frame(direction: Tensor) -> Tensor:
    """Rotations (K,3,3) whose third column is ``direction`` (K,3); the others lie anywhere across it."""
    helper = torch.nn.functional.one_hot(direction.abs().argmin(-1), 3).to(direction)
    side = torch.nn.functional.normalize(torch.linalg.cross(helper, direction), dim=-1)
    return torch.stack([side, torch.linalg.cross(direction, side), direction], dim=-1)


def _turn(angle: float, axis: int) -> Tensor:
    vector = torch.zeros(3, dtype=torch.float64)
    vector[axis] = angle
    return rotation_matrix(vector)
