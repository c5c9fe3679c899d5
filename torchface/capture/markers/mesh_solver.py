"""Blendshape weights from meshes of the rig's own topology, every vertex a marker."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.markers.smooth_problem import smooth_in_box
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.rotations import cross_matrix
from torchface.geometry.similarity import MAX_HEAD_SCALE, MIN_HEAD_SCALE, Similarity, similarity_transform
from torchface.optim import BoxQP
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig

CALM = 0.02
"""Smoothness at 60 frames a second as a share of the mean curvature of a weight: meshes have hardly any noise, so what
it settles is which of several like explanations of a frame goes on."""
_RIDGE = 1e-6
_STEADY = 1.0  # millimetres; a vertex that shapes move by this counts a quarter for the head's place
_CHUNK = 2**20  # numbers of vertices at once
_NUMBERS = "meshes: found NaN or infinity, expected millimetres in every frame"


@dataclass(frozen=True, eq=False)
class MeshSolution:
    """Weights of a mesh animation.

    Args:
        weights: (T,N) in [0,1].
        error: root mean square distance of the vertices from the rig at these weights, (T,), millimetres, without the
            head's own motion.
        motion: root mean square motion of the vertices beside the rig at rest, (T,), millimetres, likewise.
        unbounded: that error of least squares without bounds, the least that any weights reach, (T,).
    """

    weights: Tensor
    error: Tensor
    motion: Tensor
    unbounded: Tensor


class MeshSolver:
    r"""Solves meshes for blendshape weights by their normal equations.

    .. math:: \min_{0 \le w \le 1} \frac{1}{V} \lVert P (b + B w - y) \rVert^2 + \varepsilon \lVert w \rVert^2

    Each mesh y is first aligned with the rig by its steady vertices. P takes out what is left of the head's motion: the
    part along the six directions in which the rig at rest is moved and turned. H is one matrix for all frames.

    Args:
        rig: N shapes; its correctives are left out with a warning.
        ridge: :math:`\varepsilon`, as a share of the mean curvature of a weight: only what no vertex shows is
            decided by it.

    Source: thesis 4.1.4, with every vertex as a marker.

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> weights = torch.zeros(3, len(rig.names))
        >>> weights[:, rig.index(["jawOpen"])] = torch.tensor([[0.0], [0.5], [1.0]])
        >>> turned = rig(weights).flip(2) * torch.tensor([-1.0, 1.0, 1.0]) + 100.0
        >>> found = MeshSolver(rig).solve(lambda a, b: turned[a:b], 3, 30.0, temporal=False)
        >>> bool((found.weights - weights).abs().max() < 0.01)
        True
    """

    def __init__(self, rig: BlendshapeRig, ridge: float = _RIDGE) -> None:
        rig = rig.linear("MeshSolver")
        self.names = rig.names
        self.rest = rig.vertices.detach().cpu().double()
        deltas = rig.deltas.detach().cpu().double()
        rows = deltas.flatten(1).T
        arms = self.rest - self.rest.mean(0)
        turns = cross_matrix(arms).flatten(0, 1)
        shifts = torch.eye(3, dtype=torch.float64).repeat(len(arms), 1)
        self._rigid = torch.linalg.qr(torch.cat([shifts, turns], 1)).Q
        self._rows = rows - self._rigid @ (self._rigid.T @ rows)
        self._data = (2.0 / len(arms)) * (self._rows.T @ self._rows)
        self.H = self._data.clone()
        self.H.diagonal().add_(ridge * float(self.H.diagonal().mean()))
        moved = deltas.norm(dim=-1).amax(0)
        self._steady = 1 / (1 + (moved / _STEADY) ** 2) ** 2
        self._share = self._steady / self._steady.sum()
        self._at_rest = self._share @ self.rest
        self._arms = (self.rest - self._at_rest) * self._share[:, None]
        # One product for all that a frame is asked: the slopes, and its part along the rigid motions. In the order of
        # coordinates, then vertices: so a frame is turned in one product with a wide matrix.
        columns = torch.cat([self._rows, self._rigid], 1)
        columns = columns.unflatten(0, (-1, 3)).transpose(0, 1).flatten(0, 1).contiguous()
        self._columns = {dtype: columns.to(dtype) for dtype in (torch.float32, torch.float64)}
        self._around = (self.rest - self.rest.mean(0)).T.contiguous()

    def aligned(self, meshes: Tensor) -> Tensor:
        """Meshes (t,V,3) aligned with the rig at rest by their steady vertices, (t,V,3) float64.

        Raises:
            ShapeError: other vertices than the rig's.
            ValueRangeError: NaN, infinity, or another size than a head's beside the rig.
        """
        self._check(meshes)
        meshes = meshes.double()
        if not bool(torch.isfinite(meshes).all()):
            raise ValueRangeError(_NUMBERS)
        rotation, middle = self._poses(meshes.transpose(1, 2))
        return (meshes - middle[:, None]) @ rotation.transpose(1, 2) + self._at_rest

    def _poses(self, coordinates: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (t,3,3) of meshes (t,3,V) onto the rig at rest, and the steady vertices' middles (t,3) that go
        to its own."""
        middle = (coordinates @ self._share.to(coordinates)).double()
        covariance = (coordinates @ self._arms.to(coordinates)).transpose(1, 2).double()
        if not bool(torch.isfinite(covariance).all()):
            raise ValueRangeError(_NUMBERS)
        u, _, vh = torch.linalg.svd(covariance)
        sign = torch.ones(len(coordinates), 3, dtype=torch.float64)
        sign[:, 2] = torch.det(u @ vh)
        return (u * sign[:, None]) @ vh, middle

    def _check(self, meshes: Tensor) -> None:
        if meshes.ndim != 3 or meshes.shape[1:] != self.rest.shape:
            raise ShapeError(f"meshes: found {tuple(meshes.shape)}, expected (t,{len(self.rest)},3)")

    def scale_of(self, mesh: Tensor) -> float:
        """The size of a mesh (V,3) beside the rig."""
        steady = self._steady[None]
        found: Similarity = similarity_transform(mesh[None].double(), self.rest[None], steady)
        return float(1 / found.scale[0])

    def is_mirrored(self, mesh: Tensor) -> bool:
        """Whether a mesh (V,3) is the rig's mirror image, as one in left-handed axes is."""
        steady = self._share[:, None]
        own, other = (one.double() - (steady * one.double()).sum(0) for one in (self.rest, mesh))
        return float(torch.linalg.det((steady * own).T @ other)) < 0

    def check_unit(self, mesh: Tensor) -> None:
        """Raises ``ValueRangeError`` where a mesh (V,3) has not the rig's size, as one in another unit has, or is
        mirrored."""
        if self.is_mirrored(mesh):
            raise ValueRangeError(
                "meshes: found the rig's mirror image, expected right-handed axes: turn one coordinate's sign"
            )
        scale = self.scale_of(mesh)
        if not MIN_HEAD_SCALE <= scale <= MAX_HEAD_SCALE:
            raise ValueRangeError(
                f"meshes: found a head {scale:.3g} times the rig's size, expected {MIN_HEAD_SCALE} to {MAX_HEAD_SCALE} "
                "times: are both in millimetres?"
            )

    def solve(
        self,
        read: Callable[[int, int], Tensor],
        count: int,
        fps: float,
        temporal: bool = True,
        progress: Progress | None = None,
    ) -> MeshSolution:
        """Weights of all frames.

        Args:
            read: vertices (t,V,3) of the frames from one number up to another, without it, millimetres.
            count: of frames.
            fps: frames a second.
            temporal: smooth in time; each frame by itself otherwise.
            progress: called with each step and how far it is.
        """
        progress = progress or silent
        slopes = torch.empty(count, len(self.names), dtype=torch.float64)
        constant = torch.empty(count, dtype=torch.float64)
        step = max(1, _CHUNK // self.rest.numel())
        for begin in range(0, count, step):  # a chunk of frames bounds the memory
            end = min(begin + step, count)
            slopes[begin:end], constant[begin:end] = self.equations(read(begin, end))
            progress("reading meshes", end, count)
        progress("solving")
        if temporal and count > 2:
            smoothness = CALM * float(self.H.diagonal().mean())
            # In single precision it takes less than half the time and comes as near to the least.
            weights = smooth_in_box(self.H.float(), slopes.float(), fps, smoothness).double()
        else:
            weights = BoxQP(self.H, 0.0, 1.0)(slopes)
        free = -torch.linalg.solve(self.H, slopes.T).T
        errors = (self.error(slopes, constant, w) for w in (weights, torch.zeros_like(weights), free))
        error, motion, unbounded = errors
        return MeshSolution(weights, error, motion, unbounded)

    def equations(self, meshes: Tensor) -> tuple[Tensor, Tensor]:
        """The energy's slope at rest (t,N), and its value there (t,), mm² a vertex, of meshes (t,V,3)."""
        self._check(meshes)
        # Meshes of single precision stay so: beside their own rounding that of the products is little.
        dtype = torch.float32 if meshes.dtype == torch.float32 else torch.float64
        places = torch.empty(len(meshes), 3, len(self.rest), dtype=dtype).copy_(meshes.transpose(1, 2))
        places -= places.mean(2, keepdim=True)
        rotation, _ = self._poses(places)
        flat = torch.baddbmm(self._around.to(dtype).expand_as(places), rotation.to(dtype), places, beta=-1).flatten(1)
        shapes, count = len(self.names), len(self.rest)
        products = (flat @ self._columns[dtype]).double()
        size = flat.square().sum(1, dtype=torch.float64)
        return (-2.0 / count) * products[:, :shapes], (size - products[:, shapes:].square().sum(1)) / count

    def error(self, slopes: Tensor, constant: Tensor, weights: Tensor) -> Tensor:
        """Root mean square distance of the vertices at weights (T,N), (T,), millimetres."""
        squared = constant + (slopes * weights).sum(1) + 0.5 * ((weights @ self._data) * weights).sum(1)
        return squared.clamp(min=0).sqrt()

    def residual(self, meshes: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """What weights (t,N) leave of each vertex's motion, and that motion, (t,V,3) each, millimetres."""
        offset = (self.aligned(meshes) - self.rest).flatten(1)
        motion = offset - (offset @ self._rigid) @ self._rigid.T
        left = motion - weights.double() @ self._rows.T
        return left.unflatten(1, (-1, 3)), motion.unflatten(1, (-1, 3))
