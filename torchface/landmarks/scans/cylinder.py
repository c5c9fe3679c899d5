"""A head unwrapped onto a cylinder round its vertical axis, so that scans without common UVs share pixels."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import sample_texture
from torchface.rendering.raycast import RayCaster

_RAY_START = 260.0
_NEAREST_AXIS = 15.0


@dataclass(frozen=True)
class CylinderLayout:
    r"""Where a point of the face frame lies in the unwrapped image.

    The frame has its origin on the head's axis, y up, z toward the viewer. With pitch p (millimetres a pixel) and
    cylinder radius R, :math:`x = c + \frac{R}{p} \operatorname{atan2}(X, Z)` and :math:`y = c - Y / p`,
    c the centre pixel: a square on the cylinder stays a square.

    Args:
        size: pixels a side.
        pitch: millimetres a pixel on the cylinder; 0.35 at 1024 shows crown to collar and ear to ear.
        radius: of the cylinder, millimetres.

    Raises:
        ValueRangeError: a number is not positive, or the image is wider than the whole turn.

    Example:
        >>> layout = CylinderLayout(size=64, pitch=4.0)
        >>> middle = (layout.size - 1) / 2
        >>> front = layout.pixels(torch.tensor([[0.0, 0.0, 90.0]]))
        >>> bool((front - middle).abs().max() <= 0.5)
        True
    """

    size: int = 1024
    pitch: float = 0.35
    radius: float = 90.0

    def __post_init__(self) -> None:
        if self.size < 8 or not self.pitch > 0 or not self.radius > 0:
            raise ValueRangeError(f"CylinderLayout: found {self}, expected a size of at least 8 and positive lengths")
        if self.size * self.pitch > 2 * math.pi * self.radius:
            raise ValueRangeError(
                f"CylinderLayout: {self.size} pixels of {self.pitch} mm go more than once round a cylinder of radius "
                f"{self.radius} mm; expected at most {2 * math.pi * self.radius:.0f} mm"
            )

    def resized(self, size: int) -> "CylinderLayout":
        """The same field of view with ``size`` pixels a side."""
        return CylinderLayout(size, self.pitch * self.size / size, self.radius)

    def pixels(self, points: Tensor) -> Tensor:
        """Pixels (...,2), x right and y down, of points (...,3) of the face frame."""
        centre = (self.size - 1) / 2
        angle = torch.atan2(points[..., 0], points[..., 2])
        return torch.stack([centre + angle * (self.radius / self.pitch), centre - points[..., 1] / self.pitch], dim=-1)

    def points(self, pixels: Tensor, radius: Tensor) -> Tensor:
        """Points (...,3) of the face frame at pixels (...,2) and distances ``radius`` (...) from the axis."""
        centre = (self.size - 1) / 2
        angle = (pixels[..., 0] - centre) * (self.pitch / self.radius)
        return torch.stack([radius * angle.sin(), (centre - pixels[..., 1]) * self.pitch, radius * angle.cos()], dim=-1)

    def grid(self) -> Tensor:
        """Every pixel's position, (size,size,2) float64."""
        along = torch.arange(self.size, dtype=torch.float64)
        return torch.stack(torch.meshgrid(along, along, indexing="xy"), dim=-1)


@dataclass(frozen=True, eq=False)
class UnwrappedHead:
    """What the outermost surface shows round a head's axis.

    Args:
        layout: of the image.
        pose: from the scan's space to the face frame, a batch of one.
        triangle: under each pixel, (S,S) int64, -1 where there is none.
        barycentric: in that triangle, (S,S,3).
        radius: distance from the axis, (S,S) float32, millimetres of the face frame; holes are filled smoothly.
        texture: colours (3,S,S) in [0,1], holes filled; None where the scan brings no colour.
    """

    layout: CylinderLayout
    pose: Similarity
    triangle: Tensor
    barycentric: Tensor
    radius: Tensor
    texture: Tensor | None

    @property
    def mask(self) -> Tensor:
        """Where the scan has a surface, (S,S) bool."""
        return self.triangle >= 0

    def surface_points(self, mesh: Mesh, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Where pixels lie on the scan.

        Args:
            mesh: the scan that was unwrapped.
            pixels: (N,2).

        Returns:
            Points (N,3) in the scan's space, and whether each lies on the scan itself, (N,) bool. In a hole the point
            is where the filled surface runs.
        """
        size = self.layout.size
        column = pixels[:, 0].round().long().clamp(0, size - 1)
        row = pixels[:, 1].round().long().clamp(0, size - 1)
        triangle = self.triangle[row, column]
        weights = self.barycentric[row, column].to(mesh.vertices.dtype)
        on_scan = (mesh.vertices[mesh.faces[triangle.clamp(min=0)]] * weights[..., None]).sum(1)
        filled = self.layout.points(pixels.double(), self.radius[row, column].double())
        filled = self.pose.inverse().apply(filled)[0].to(on_scan)
        seen = triangle >= 0
        return torch.where(seen[:, None], on_scan, filled), seen


def unwrap(mesh: Mesh, pose: Similarity, layout: CylinderLayout | None = None) -> UnwrappedHead:
    """Unwraps the outermost surface of a head: a ray toward the axis a pixel.

    Args:
        mesh: a scan in any space.
        pose: from that space to the face frame, a batch of one.
        layout: of the image.

    Raises:
        ShapeError: the pose is not one.
        ValueRangeError: no ray hits the scan: the pose does not belong to it.

    Source: thesis 3.2.2 (UV space); the cylinder stands in for the UVs that raw scans do not share.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> still = Similarity(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3))
        >>> unwrapped = unwrap(head, still, CylinderLayout(size=64, pitch=4.0))
        >>> bool(unwrapped.mask[32, 32]), 50 < unwrapped.radius[32, 32].item() < 150
        (True, True)
    """
    layout = layout or CylinderLayout()
    if len(pose.scale) != 1:
        raise ShapeError(f"unwrap: found {len(pose.scale)} poses, expected one")
    vertices = pose.apply(mesh.vertices.double())[0]
    pixels = layout.grid().view(-1, 2)
    starts = layout.points(pixels, torch.full((len(pixels),), _RAY_START, dtype=torch.float64))
    ways = torch.nn.functional.normalize(starts * torch.tensor([-1.0, 0.0, -1.0], dtype=torch.float64), dim=-1)
    hits = RayCaster(vertices, mesh.faces).cast(starts, ways)
    radius = _RAY_START - hits.distance
    seen = (hits.triangle >= 0) & (radius > _NEAREST_AXIS)
    if not seen.any():
        raise ValueRangeError("unwrap: found no surface round the axis, expected a pose that fits the scan")
    shape = (layout.size, layout.size)
    mask = seen.view(shape)
    triangle = hits.triangle.masked_fill(~seen, -1)
    colors = _colors(mesh, triangle, hits.barycentric.double())
    filled = None if colors is None else fill_holes(colors.T.reshape(3, *shape), mask)
    return UnwrappedHead(
        layout,
        pose,
        triangle.view(shape),
        hits.barycentric.float().view(*shape, 3),
        fill_holes(radius.masked_fill(~seen, 0.0).float().view(1, *shape), mask)[0],
        filled,
    )


def _colors(mesh: Mesh, triangle: Tensor, barycentric: Tensor) -> Tensor | None:
    """Colours (P,3) under the pixels; rows without a triangle are arbitrary."""
    known = triangle.clamp(min=0)
    weights = barycentric.float()[..., None]
    if mesh.texture is not None and mesh.uvs is not None and mesh.uv_faces is not None:
        return sample_texture(mesh.texture, (mesh.uvs.float()[mesh.uv_faces[known]] * weights).sum(1))
    if mesh.colors is not None:
        return (mesh.colors.float()[mesh.faces[known]] * weights).sum(1)
    return None


def fill_holes(image: Tensor, mask: Tensor) -> Tensor:
    """Keeps an image (C,H,W) where the mask is set and fills the rest from ever coarser means around (push and pull).

    Source: Gortler et al. 1996, The Lumigraph, 3.4.
    """
    weight = mask[None, None].to(image)
    return _pull(image[None] * weight, weight)[0]


def _pull(weighted: Tensor, weight: Tensor) -> Tensor:
    known = weighted / weight.clamp(min=1e-9)
    height, width = weight.shape[-2:]
    if bool((weight > 0).all()) or max(height, width) == 1:
        return known
    odd = (0, width % 2, 0, height % 2)
    coarse = _pull(avg_pool2d(pad(weighted, odd), 2), avg_pool2d(pad(weight, odd), 2))
    around = interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)[..., :height, :width]
    return torch.where(weight > 0, known, around)
