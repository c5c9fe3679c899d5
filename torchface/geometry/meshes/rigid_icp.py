"""Rigid pose of a known surface on a scan: by landmarks, or by its shape alone, in any pose."""

import math
from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.errors import AlignmentError
from torchface.geometry.meshes.operators import border_vertices, vertex_normals
from torchface.geometry.rotations import quaternion_matrix
from torchface.geometry.similarity import MAX_HEAD_SCALE, MIN_HEAD_SCALE, Similarity

_SEED = 0
_ROTATIONS = 400
_LANDMARK_WEIGHT = 20.0
_DAMPING = 1e-6
_LEAST_FIT, _SLID_OFF = 0.35, 0.9
_SCAN_POINTS = 20_000


def falling_reaches(first: float, last: float, steps: int) -> tuple[float, ...]:
    """Reaches of the steps of :func:`rigid_icp`, each the same share of the one before, millimetres."""
    return tuple(first * (last / first) ** (i / (steps - 1)) for i in range(steps))


# Of each round: points, reaches, poses that are kept after a third of the steps and at the end, slack of the matches.
_SEARCH = (
    (120, falling_reaches(80, 40, 8), 80, 40, 1.0),
    (400, falling_reaches(40, 15, 12), 12, 8, 0.5),
    (1500, falling_reaches(20, 8, 20), 2, 1, 0.0),
)


@dataclass(frozen=True, eq=False)
class Samples:
    """Points (N,3) and unit normals (N,3) of a template, float64, in an order whose beginnings are spread too."""

    points: Tensor
    normals: Tensor

    def first(self, count: int) -> "Samples":
        """Fewer of them."""
        return Samples(self.points[:count], self.normals[:count])

    @staticmethod
    def of(vertices: Tensor, faces: Tensor, ids: Tensor) -> "Samples":
        """Vertices ``ids`` in an order drawn once for all."""
        order = ids[torch.randperm(len(ids), generator=torch.Generator().manual_seed(_SEED))]
        points = vertices.double()
        return Samples(points[order], vertex_normals(points, faces)[order])


class ScanPoints:
    """Points (N,3) of a scan with unit normals (N,3), float64, to look up the nearest; beyond ``border`` the scan
    ends."""

    def __init__(self, points: Tensor, normals: Tensor, border: Tensor) -> None:
        self.points, self.normals, self.border = points, normals, border
        self._tree = cKDTree(points.numpy(), leafsize=64)  # of 16 a query far from all points takes twice as long

    @staticmethod
    def of(vertices: Tensor, faces: Tensor, whole_border: bool = False) -> "ScanPoints":
        """Vertices of a scan, at most 20,000; with ``whole_border`` all of its border are among them."""
        points = vertices.double()
        normals = vertex_normals(points, faces)
        used = (normals.norm(dim=1) > 0.5).nonzero()[:, 0]
        keep = used[torch.randperm(len(used), generator=torch.Generator().manual_seed(_SEED))[:_SCAN_POINTS]]
        border = border_vertices(faces, len(points))
        if whole_border:
            keep = torch.cat([keep, used[border[used]]]).unique()
        return ScanPoints(points[keep], normals[keep], border[keep])

    def nearest(self, queries: Tensor, slack: float = 0.0) -> tuple[Tensor, Tensor]:
        """Distance and row of a point at most ``1 + slack`` times as far as the nearest from each query (...,3)."""
        distance, row = self._tree.query(queries.reshape(-1, 3).numpy(), eps=slack)
        shape = queries.shape[:-1]
        return torch.from_numpy(distance).reshape(shape), torch.from_numpy(row).reshape(shape)


@dataclass(frozen=True, eq=False)
class Fit:
    """Similarities, a batch of B, and how well each fits: the mean weight of its correspondences, (B,) in [0,1]."""

    pose: Similarity
    fit: Tensor

    def best(self, count: int) -> "Fit":
        """The best fitting ones, best first."""
        order = self.fit.argsort(descending=True, stable=True)[:count]
        return Fit(self.pose[order], self.fit[order])


def rigid_icp(
    samples: Samples,
    scan: ScanPoints,
    start: Similarity,
    reaches: tuple[float, ...],
    scale: bool = False,
    landmarks: tuple[Tensor, Tensor] | None = None,
    slack: float = 0.0,
) -> Fit:
    r"""Iterated closest points from many starts at once, across the surface and with falling reach.

    .. math:: \min_{s,R,t} \sum_i w_i \big(n_i \cdot (s R x_i + t - u_i)\big)^2 + \lambda \sum_l \lVert s R x_l + t -
        u_l \rVert^2, \qquad w_i = \max(0, R m_i \cdot n_i)\,(1 + d_i^2 / c^2)^{-2}

    Args:
        samples: x with normals m.
        scan: u with normals n.
        start: B similarities.
        reaches: c of each step, millimetres.
        scale: estimate s, within 0.8 to 1.25 of where it started.
        landmarks: x and u, (L,3) each.
        slack: of the nearest points, which then are found sooner.

    Source: Chen, Medioni 1992 (across the surface); Rusinkiewicz, Levoy 2001; thesis 3.2.3, figure 16.
    """
    pose = Similarity(start.scale.double(), start.rotation.double(), start.translation.double())
    lowest, highest = pose.scale * MIN_HEAD_SCALE, pose.scale * MAX_HEAD_SCALE
    for reach in reaches:
        moved, targets, normals, weights = _planes(samples, scan, pose, reach, slack)
        if landmarks is not None:
            extra = _landmark_planes(landmarks, pose, len(samples.points))
            pairs = zip((moved, targets, normals, weights), extra, strict=True)
            moved, targets, normals, weights = (torch.cat(pair, dim=1) for pair in pairs)
        centre = moved.mean(1, keepdim=True)
        arm = moved - centre
        left = ((targets - moved) * normals).sum(-1)
        rows = [torch.linalg.cross(arm, normals), normals, (arm * normals).sum(-1, keepdim=True)]
        jacobian = torch.cat(rows if scale else rows[:2], dim=-1)
        weighted = jacobian * weights[..., None]
        matrix = weighted.transpose(1, 2) @ jacobian
        size = matrix.diagonal(dim1=1, dim2=2)
        matrix = matrix + torch.diag_embed(_DAMPING * size + 1e-9 * size.amax(1, keepdim=True) + 1e-12)
        step = torch.linalg.solve(matrix, (weighted * left[..., None]).sum(1))
        growth = (1 + step[:, 6]).clamp(0.9, 1.1) if scale else torch.ones_like(pose.scale)
        growth = (pose.scale * growth).clamp(lowest, highest) / pose.scale
        pose = pose.moved(step[:, :3], growth, step[:, 3:6], centre[:, 0])
    return Fit(pose, fit_of(samples, scan, pose, reaches[-1], slack))


def fit_of(samples: Samples, scan: ScanPoints, pose: Similarity, reach: float, slack: float = 0.0) -> Tensor:
    """How well the template fits in B similarities, (B,) in [0,1]: the mean weight of its correspondences."""
    return _planes(samples, scan, pose, reach, slack)[3].mean(1)


def find_pose(samples: Samples, scan: ScanPoints, size: float = 1.0) -> Fit:
    """The similarity that lays the template on the scan, found from starts in all directions.

    Few points of the template from 400 rotations, then more of them from the best of these, and all from the best few.

    Args:
        samples: of the template.
        scan: where to find it.
        size: times its own that the template starts with; of a size that differs by more than a tenth little is found.
    """
    all_rotations = even_rotations(_ROTATIONS)
    sizes = torch.full((len(all_rotations),), size, dtype=torch.float64)
    middle = (scan.points.amax(0) + scan.points.amin(0)) / 2
    own = (samples.points.amax(0) + samples.points.amin(0)) / 2
    start = Similarity(sizes, all_rotations, middle - size * (all_rotations @ own))
    most = Fit(start, start.scale)
    for first, reaches, half, kept, slack in _SEARCH:
        start = most.pose
        some, scale, early = samples.first(first), slack == 0, len(reaches) // 3 + 1
        left = rigid_icp(some, scan, start, reaches[:early], scale, slack=slack).best(half)
        most = rigid_icp(some, scan, left.pose, reaches[early:], scale, slack=slack).best(kept)
    # Few points of a surface near a sphere determine no size: it shrinks until they leave the surface.
    before = Fit(start, fit_of(some, scan, start, reaches[-1])).best(1)
    if float(most.fit[0]) < _SLID_OFF * float(before.fit[0]):
        most = before
    if float(most.fit[0]) < _LEAST_FIT:
        raise AlignmentError(
            f"found no pose that fits (best fit {float(most.fit[0]):.2f} of 1, expected at least {_LEAST_FIT})"
        )
    return most


def _planes(
    samples: Samples, scan: ScanPoints, pose: Similarity, reach: float, slack: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Moved samples, their scan points, normals, each (B,N,3), and weights (B,N)."""
    moved = pose.apply(samples.points)
    own = samples.normals @ pose.rotation.transpose(1, 2)
    distance, row = scan.nearest(moved, slack)
    normals = scan.normals[row]
    agree = (own * normals).sum(-1).clamp(min=0)
    weights = agree * (1 + (distance / reach).square()).pow(-2) * ~scan.border[row]
    return moved, scan.points[row], normals, weights


def _landmark_planes(
    landmarks: tuple[Tensor, Tensor], pose: Similarity, count: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Each landmark as three planes through its scan point, (B,3L,3); together they weigh 20 times the samples."""
    moved = pose.apply(landmarks[0].double()).repeat_interleave(3, 1)
    targets = landmarks[1].double().repeat_interleave(3, 0).expand_as(moved)
    normals = torch.eye(3, dtype=torch.float64).repeat(len(landmarks[0]), 1).expand_as(moved)
    weight = _LANDMARK_WEIGHT * count / moved.shape[1]
    return moved, targets, normals, torch.full(moved.shape[:2], weight, dtype=torch.float64)


def even_rotations(count: int) -> Tensor:
    """Rotations (N,3,3) spread evenly over all, the first the identity.

    Source: Alexa 2022, Super-Fibonacci spirals: fast, low-discrepancy sampling of SO(3).
    """
    i = torch.arange(count, dtype=torch.float64) + 0.5
    t, d = i / count, 2 * math.pi * i
    r, rest = t.sqrt(), (1 - t).sqrt()
    a, b = d / math.sqrt(2), d / 1.533751168755204288118041
    x, y, z, w = r * a.sin(), r * a.cos(), rest * b.sin(), rest * b.cos()
    rotations = quaternion_matrix(torch.stack([x, y, z, w], dim=-1))
    return torch.cat([torch.eye(3, dtype=torch.float64)[None], rotations])
