"""Samples of the skin in frames: colours of vertices beside their known albedo."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.color_space import to_linear
from torchface.errors import AlignmentError, ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import triangle_areas, vertex_normals
from torchface.rendering.camera_visibility import shown_in
from torchface.rendering.point_light import in_camera_frame, lit_by
from torchface.rendering.raycast import RayCaster

MIN_VERTICES = 60
"""Vertices that the frames have to show at least: nine numbers are wanted, and much of a face may shine or be hairy."""

_SQUARELY = 0.25  # cosine; what is seen more obliquely is mixed with what stands behind
_BLACK, _BLOWN = 0.02, 0.985  # sRGB; beyond, a value only says that the light was less, or more
_SAME = 1.5 / 255  # sRGB, median; noise and coding alone part a true albedo under even light from the frame by more
_MOST_AREA = 4.0  # of the mean; one large triangle shall not speak for all


@dataclass(frozen=True, eq=False)
class SeenSkin:
    """Q vertices of all frames together, in the camera's frame, float64."""

    points: Tensor  # (Q,3), millimetres
    normals: Tensor  # unit, (Q,3)
    albedo: Tensor  # linear, (Q,3)
    colors: Tensor  # of the frames there, linear, (Q,3)
    valid: Tensor  # 0 where a channel is blown out, else 1, (Q,3)
    area: Tensor  # pixels that a vertex stands for, of mean 1, (Q,)
    frame: Tensor  # which of the T frames, (Q,) int64
    vertex: Tensor  # which vertex, (Q,) int64
    casters: tuple[RayCaster, ...]  # the mesh in each frame

    @property
    def centre(self) -> Tensor:
        """The middle of what was seen, (3,)."""
        return (self.area[:, None] * self.points).sum(0) / self.area.sum()

    def lit_by(self, position: Tensor) -> Tensor:
        """Which of the vertices a source at a position (3,) reaches, (Q,) bool."""
        lit = torch.zeros(len(self.points), dtype=torch.bool)
        for t, caster in enumerate(self.casters):  # a frame at a time: each has a mesh of its own
            rows = (self.frame == t).nonzero()[:, 0]
            lit[rows] = lit_by(position, caster, self.points[rows], self.normals[rows])
        return lit

    def thinned(self, most: int) -> "SeenSkin":
        """At most so many of the vertices, evenly through all of them."""
        rows = torch.arange(0, len(self.points), max(1, -(-len(self.points) // most)))
        return replace(
            self,
            points=self.points[rows],
            normals=self.normals[rows],
            albedo=self.albedo[rows],
            colors=self.colors[rows],
            valid=self.valid[rows],
            area=self.area[rows],
            frame=self.frame[rows],
            vertex=self.vertex[rows],
        )


def seen_skin(
    frames: Tensor,
    vertices: Tensor,
    faces: Tensor,
    albedo: Tensor,
    cameras: Sequence[Camera],
    weights: Tensor,
    calibration: CameraCalibration | None,
) -> SeenSkin:
    """The vertices that frames show squarely and not blown out.

    Args:
        frames: (T,3,H,W) sRGB in [0,1].
        vertices: in each frame, (T,V,3), millimetres.
        albedo: (V,3) sRGB.
        weights: of the vertices, (V,); 0 leaves one out.
    """
    parts, casters = [], []
    for t, camera in enumerate(cameras):  # a frame at a time: each has a mesh of its own
        points = in_camera_frame(camera, vertices[t])
        normals = vertex_normals(points, faces)
        caster = RayCaster(points, faces)
        unmoved = replace(camera, rotation=torch.eye(3).double(), translation=torch.zeros(3).double())
        shown = shown_in(frames[t], unmoved, caster, points, normals, calibration)
        telling = (shown.colors < _BLOWN).any(-1) & (albedo > _BLACK).any(-1) & (weights > 0)
        rows = ((shown.cosine > _SQUARELY) & telling).nonzero()[:, 0]
        around = torch.zeros(len(points), dtype=torch.float64)
        around.index_add_(0, faces.flatten(), triangle_areas(points, faces).repeat_interleave(3) / 3)
        area = weights[rows] * around[rows] * shown.cosine[rows] / points[rows, 2].square()
        parts.append((points[rows], normals[rows], shown.colors[rows].double(), area, torch.full_like(rows, t), rows))
        casters.append(caster)
    points, normals, colors, area, frame, vertex = (torch.cat(part) for part in zip(*parts, strict=True))
    skin = albedo[vertex].double()
    _check_seen(colors, skin, len(albedo))
    area = (area / area.mean()).clamp(max=_MOST_AREA)
    valid = (colors < _BLOWN).double()
    return SeenSkin(points, normals, to_linear(skin), to_linear(colors), valid, area, frame, vertex, tuple(casters))


def _check_seen(colors: Tensor, albedo: Tensor, count: int) -> None:
    if len(colors) < MIN_VERTICES:
        raise AlignmentError(
            f"estimate_light: found {len(colors)} of {count} vertices in the image, seen squarely and not blown out, "
            f"expected at least {MIN_VERTICES}; is the face in the frame?"
        )
    if float(colors.amax(-1).quantile(0.95)) < _BLACK:
        raise ValueRangeError("frame: found the face black, expected one that is lit")
    if float((colors - albedo).abs().amax(-1).median()) < _SAME:
        raise ValueRangeError(
            "albedo: found the frame's own colours, which hold its light already (the answer would be even light "
            "whatever it was); expected the albedo of a scan or of a colour model"
        )
