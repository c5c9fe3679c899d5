"""What of a filmed face is to be seen in a frame: hands, hair and glasses before it look unlike it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.color_space import to_linear
from torchface.errors import ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import vertex_normals
from torchface.rendering.camera_visibility import shown_in
from torchface.rendering.gaussian_blur import gaussian_blur
from torchface.rendering.pixel_coverage import footprint
from torchface.rendering.point_light import PointLight, in_camera_frame, irradiance, lit_by
from torchface.rendering.raycast import RayCaster

_SQUARE = 0.3  # cosine below which a vertex is seen from the side, where neighbours mix
_FLOOR = 0.02  # linear; darker pixels are noise
_LEAST, _MOST = (0.25, 0.06, 0.06), (0.6, 0.15, 0.15)  # deviations of brightness and of two ratios of channels
_UNKNOWN = 1e3  # deviation of what was never seen: anything may be there
_FEWEST = 3  # frames that show a vertex
_ALIKE, _UNLIKE = 2.5, 4.5  # deviations
_PATCH = 0.012  # of the square root of the face's area: smaller specks are no hands


@dataclass(frozen=True, eq=False)
class UncoveredSkin:
    """How the surface of a face looks with nothing before it: medians over a film, freed of its light.

    Args:
        middle: of each vertex, brightness and the ratios of red and blue to green, logarithms, (V,3).
        deviation: how far they scatter, (V,3).
    """

    middle: Tensor
    deviation: Tensor

    @staticmethod
    def of(
        frames: Sequence[Tensor],
        vertices: Sequence[Tensor],
        faces: Tensor,
        cameras: Sequence[Camera],
        lights: Sequence[PointLight],
        calibration: CameraCalibration | None = None,
    ) -> UncoveredSkin:
        """Learns from frames of a film; what covers a place in half of them or more counts as the face.

        Args:
            frames: (3,H,W) uint8 each, some spread over the film.
            vertices: of the face in each, (V,3), millimetres.
            faces: (F,3) int64.
            cameras, lights: of each.
            calibration: of a lens that bends the frames.

        Raises:
            ValueRangeError: there are no frames.
        """
        if not frames:
            raise ValueRangeError("frames: found none with a face, expected some")
        looks = []
        for frame, posed, camera, light in zip(frames, vertices, cameras, lights, strict=True):
            posed = posed.double()
            caster, normals = RayCaster(posed, faces), vertex_normals(posed, faces)
            shown = shown_in(frame.float() / 255, camera, caster, posed, normals, calibration)
            points, turned = in_camera_frame(camera, posed), normals @ camera.rotation.double().T
            lit = lit_by(light.position, RayCaster(points, faces), points, turned).double()
            look = _look(to_linear(shown.colors), irradiance(points, turned, light, lit).float())
            looks.append(torch.where((shown.cosine > _SQUARE)[:, None], look, torch.nan))
        stacked = torch.stack(looks)
        middle = stacked.nanmedian(0).values
        deviation = 1.4826 * (stacked - middle).abs().nanmedian(0).values
        deviation = deviation.clamp(torch.tensor(_LEAST), torch.tensor(_MOST))
        known = (stacked[..., 0].isfinite().sum(0) >= min(_FEWEST, len(frames)))[:, None]
        return UncoveredSkin(middle.where(known, 0.0), deviation.where(known, _UNKNOWN))

    def mask(
        self,
        frame: Tensor,
        vertices: Tensor,
        faces: Tensor,
        camera: Camera,
        light: PointLight,
        calibration: CameraCalibration | None = None,
    ) -> Tensor:
        """How far each pixel of a frame shows the face or what is behind it, (H,W) in [0,1]; 0 where it is covered.

        Args:
            frame: (3,H,W) uint8.
            vertices: of the face in it, (V,3), millimetres.
            faces: (F,3) int64.
            camera, light: of the frame.
            calibration: of a lens that bends the frame.
        """
        covered = footprint(vertices, faces, torch.ones(len(faces), dtype=torch.bool), camera, calibration)
        mask = torch.ones(camera.height * camera.width)
        if len(covered.pixel) == 0:
            return mask.view(camera.height, camera.width)
        linear = to_linear(frame.float() / 255).reshape(3, -1).T[covered.pixel]
        lit = lit_by(light.position, covered.caster, covered.points, covered.normals)
        lit = covered.softened(lit[:, None])[:, 0].double()
        look = _look(linear, irradiance(covered.points, covered.normals, light, lit).float())
        middle, deviation = (covered.of_vertices(x.double(), faces).float() for x in (self.middle, self.deviation))
        apart = ((look - middle) / deviation).square().sum(1).sqrt()
        unlike = ((apart - _ALIKE) / (_UNLIKE - _ALIKE)).clamp(0, 1)
        mask.index_put_((covered.pixel,), 1 - unlike)  # of an edge's samples any
        sigma = max(1.0, _PATCH * math.sqrt(float(covered.share.sum())))
        smooth = gaussian_blur(mask.view(1, 1, camera.height, camera.width), sigma)[0, 0]
        return ((smooth - 0.35) / 0.3).clamp(0, 1)


def _look(linear: Tensor, light: Tensor) -> Tensor:
    """Brightness and the two ratios of what reflects, logarithms, (S,3)."""
    reflected = (linear.clamp(min=0) + _FLOOR).log() - (light + _FLOOR).log()
    red, green, blue = reflected.unbind(-1)
    return torch.stack([reflected.mean(-1), red - green, blue - green], -1)
