"""Coverage of an image's pixels by a mesh: with which part of it, and by what share at its edges."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.distortion import distort, undistort
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.rasterization import interpolate
from torchface.rendering.gaussian_blur import gaussian_blur
from torchface.rendering.point_light import in_camera_frame
from torchface.rendering.raycast import RayCaster

_EDGE_SAMPLES = 4  # a pixel side, where the surface ends or jumps
_JUMP = 0.006  # of the distance; neighbours that differ by more lie on different parts of the face
_NEAR = 1.0  # millimetres before the lens


@dataclass(frozen=True, eq=False)
class Footprint:
    """S samples of a mesh in an image: one at the centre of a pixel inside, several where the surface ends."""

    pixel: Tensor  # row-major index of the pixel, (S,) int64
    share: Tensor  # of its pixel that a sample stands for, (S,)
    triangle: Tensor  # (S,) int64
    barycentric: Tensor  # in it, (S,3)
    points: Tensor  # in the camera's frame, (S,3), millimetres
    normals: Tensor  # there, unit, smooth, (S,3)
    caster: RayCaster  # the mesh in the camera's frame
    height: int
    width: int

    def of_vertices(self, values: Tensor, faces: Tensor) -> Tensor:
        """Values (V,C) of vertices at the samples, (S,C)."""
        return interpolate(values, faces[self.triangle], self.barycentric)

    def select(self, rows: Tensor) -> "Footprint":
        """Some of the samples."""
        return replace(
            self,
            pixel=self.pixel[rows],
            share=self.share[rows],
            triangle=self.triangle[rows],
            barycentric=self.barycentric[rows],
            points=self.points[rows],
            normals=self.normals[rows],
        )

    def softened(self, values: Tensor, weights: Tensor | None = None, sigma: float = 1.0) -> Tensor:
        """Values (S,C) of the samples, blurred by ``sigma`` pixels; each counts by weights (S,) beside its share of
        a pixel."""
        weight = (self.share if weights is None else self.share * weights).float()[:, None]
        rows, columns = self.pixel // self.width, self.pixel % self.width
        (top, left), (bottom, right) = (int(rows.min()), int(columns.min())), (int(rows.max()), int(columns.max()))
        height, width = bottom - top + 1, right - left + 1
        place = (rows - top) * width + columns - left
        summed = torch.zeros(height * width, values.shape[1] + 1)
        summed.index_add_(0, place, torch.cat([weight * values.float(), weight], dim=1))
        blurred = gaussian_blur(summed.T.reshape(1, -1, height, width), sigma)[0].flatten(1).T[place]
        return blurred[:, :-1] / blurred[:, -1:].clamp(min=1e-6)

    def blended(self, image: Tensor, over: Tensor, alpha: Tensor) -> Tensor:
        """An image (3,H,W) with what the samples bring, (S,3) times alpha (S,) already, blended over it."""
        flat = image.reshape(3, -1).T
        weight = self.share.to(flat)[:, None]
        drawn = torch.zeros(len(flat), 4, dtype=flat.dtype)
        drawn.index_add_(0, self.pixel, weight * torch.cat([over, alpha[:, None]], dim=1).to(flat))
        return (flat * (1 - drawn[:, 3:]) + drawn[:, :3]).T.reshape(image.shape)


def footprint(
    vertices: Tensor, faces: Tensor, shows: Tensor, camera: Camera, calibration: CameraCalibration | None = None
) -> Footprint:
    """The samples of those triangles that show, (F,) bool: what the mesh hides, or is seen from behind, is missing.

    Rays are bent as by the calibration's lens, so that nothing has to be warped.
    """
    points = in_camera_frame(camera, vertices)
    caster = RayCaster(points, faces)
    left, top, right, bottom = _box(points, camera, calibration)
    width, height = max(right - left, 0), max(bottom - top, 0)
    x, y = torch.arange(left, left + width).double(), torch.arange(top, top + height).double()
    grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)
    normals = vertex_normals(points, faces)
    coarse = _sampled(caster, grid, camera, calibration, points, faces, normals, shows)
    edge = _edges(coarse.depth.view(height, width)).flatten() if len(grid) else torch.zeros(0, dtype=torch.bool)
    step = (torch.arange(_EDGE_SAMPLES, dtype=torch.float64) + 0.5) / _EDGE_SAMPLES - 0.5
    offsets = torch.stack(torch.meshgrid(step, step, indexing="xy"), dim=-1).reshape(-1, 2)
    fine_grid = (grid[edge][:, None] + offsets).reshape(-1, 2)
    fine = _sampled(caster, fine_grid, camera, calibration, points, faces, normals, shows)
    inside = (coarse.depth.isfinite() & ~edge).nonzero()[:, 0]
    within = fine.depth.isfinite().nonzero()[:, 0]
    column, row = grid.unbind(1)
    pixel = (row * camera.width + column).long()
    pixels = torch.cat([pixel[inside], pixel[edge].repeat_interleave(len(offsets))[within]])
    share = torch.cat([torch.ones(len(inside)), torch.full((len(within),), 1 / len(offsets))])
    return Footprint(
        pixels,
        share.double(),
        torch.cat([coarse.triangle[inside], fine.triangle[within]]),
        torch.cat([coarse.barycentric[inside], fine.barycentric[within]]),
        torch.cat([coarse.points[inside], fine.points[within]]),
        torch.cat([coarse.normals[inside], fine.normals[within]]),
        caster,
        camera.height,
        camera.width,
    )


@dataclass(frozen=True, eq=False)
class _Samples:
    """Per ray; ``depth`` is infinite where none of the wanted triangles is in front."""

    triangle: Tensor
    barycentric: Tensor
    points: Tensor
    normals: Tensor
    depth: Tensor


def _sampled(
    caster: RayCaster,
    pixels: Tensor,
    camera: Camera,
    calibration: CameraCalibration | None,
    vertices: Tensor,
    faces: Tensor,
    normals: Tensor,
    shows: Tensor,
) -> _Samples:
    if calibration is not None:
        pixels = undistort(pixels, calibration)
    ways = torch.cat([pixels, torch.ones(len(pixels), 1, dtype=pixels.dtype)], dim=1)
    ways = ways @ torch.linalg.inv(camera.intrinsics.double()).T
    unseen = ~torch.isfinite(ways).all(1)  # beyond what the lens shows at all
    ways = torch.nn.functional.normalize(ways.masked_fill(unseen[:, None], 1.0), dim=-1)
    hits = caster.cast(torch.zeros_like(ways), ways)
    triangle = hits.triangle.clamp(min=0)
    barycentric = hits.barycentric.double()
    points = ways * hits.distance.masked_fill(hits.triangle < 0, 0.0)[:, None]
    a, b, c = (vertices[faces[triangle, k]] for k in range(3))
    facing = (torch.linalg.cross(b - a, c - a) * ways).sum(1) < 0
    seen = (hits.triangle >= 0) & shows[triangle] & facing & ~unseen
    smooth = sum(normals[faces[triangle, k]] * barycentric[:, k : k + 1] for k in range(3))
    return _Samples(
        triangle,
        barycentric,
        points,
        torch.nn.functional.normalize(torch.as_tensor(smooth), dim=-1),
        points[:, 2].masked_fill(~seen, torch.inf),
    )


def _box(points: Tensor, camera: Camera, calibration: CameraCalibration | None) -> tuple[int, int, int, int]:
    """Left, top, right, bottom (one beyond) of the mesh in the image."""
    if bool((points[:, 2] < _NEAR).any()):
        in_front = points[points[:, 2] >= _NEAR]
        return (0, 0, camera.width, camera.height) if len(in_front) else (0, 0, 0, 0)
    seen = points @ camera.intrinsics.double().T
    pixels = seen[:, :2] / seen[:, 2:]
    if calibration is not None:
        pixels = distort(pixels, calibration)
    limit = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    low = (pixels.amin(0) - 1).floor().clamp(min=torch.zeros(2).double(), max=limit).long().tolist()
    high = (pixels.amax(0) + 2).ceil().clamp(min=torch.zeros(2).double(), max=limit).long().tolist()
    return low[0], low[1], high[0], high[1]


def _edges(depth: Tensor) -> Tensor:
    """Pixels (h,w) where the surface ends or jumps toward one of four neighbours."""
    edge = torch.zeros(depth.shape, dtype=torch.bool)
    for axis in (0, 1):
        here, there = depth.narrow(axis, 0, depth.shape[axis] - 1), depth.narrow(axis, 1, depth.shape[axis] - 1)
        # Two infinities differ by NaN, which is no jump; one differs by infinity, which is.
        jump = (here - there).abs() > _JUMP * torch.minimum(here, there)
        edge.narrow(axis, 0, depth.shape[axis] - 1).logical_or_(jump)
        edge.narrow(axis, 1, depth.shape[axis] - 1).logical_or_(jump)
    return edge
