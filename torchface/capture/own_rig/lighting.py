"""The light that a face is filmed in, from its albedo and the frame: ambient light and one point source."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.own_rig.light_search import SourceFit, find_source, information
from torchface.capture.own_rig.skin_samples import SeenSkin, seen_skin
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.pinhole import Camera
from torchface.rendering.point_light import PointLight

__all__ = ["LightFit", "PointLight", "estimate_light"]

_OUTLIER = 0.25  # of a vertex's full weight: residuals beyond the width of the robust estimator


@dataclass(frozen=True, eq=False)
class LightFit:
    """A light, and how well it explains T frames of V vertices.

    Args:
        light: in the camera's frame; its strengths belong to the albedo that was given.
        direction: unit, from the middle of what was seen toward the source, camera's frame, (3,).
        distance: of the source from there, millimetres; 100,000 is the directional limit. A face is small beside
            that distance, so it is found roughly, the direction well.
        deviation: of the direction, degrees, as the curvature of the objective and the inliers' errors show; infinite
            where no source shows. Wrong geometry and wrong albedo come on top.
        errors: difference between shaded albedo and frame, sRGB, Euclidean, (T,V); NaN where not seen.
        visible: vertices that a frame shows squarely, (T,V).
        lit: those of them that the source reaches, (T,V).
        inliers: those that the light explains: no highlight, foreign shadow, hair or wrong albedo, (T,V).
    """

    light: PointLight
    direction: Tensor
    distance: float
    deviation: float
    errors: Tensor
    visible: Tensor
    lit: Tensor
    inliers: Tensor

    @property
    def error(self) -> float:
        """Root mean square of the inliers' errors; colours go to 1."""
        return float(self.errors[self.inliers].square().mean().sqrt())


def estimate_light(
    frame: Tensor,
    vertices: Tensor,
    faces: Tensor,
    albedo: Tensor,
    camera: Camera | Sequence[Camera],
    weights: Tensor | None = None,
    calibration: CameraCalibration | None = None,
) -> LightFit:
    r"""The ambient light, and the source's strength and position, under which an albedo looks as the frame shows it.

    .. math:: \min_{I_a, I_p, L} \sum_v a_v\, \phi\big( \lVert g(T_v (I_a + I_p \max(0, N_v \cdot L_v)\, s_v))
        - C_v \rVert \big), \qquad I_a, I_p \ge 0

    over the vertices that the camera sees. s is 0 where the mesh stands between vertex and source, a the pixels that a
    vertex covers, g the sRGB coding (light adds up in linear values: colours are decoded first), :math:`\phi` Geman
    and McClure's function of a width taken from the residuals, so that highlights, foreign shadows and hair count
    little. Blinn's highlight, at most 0.3 of the source, is estimated with the rest, or its broad part would pass for
    light, and left out of the answer. Directions all round are tried; from the best, Gauss-Newton moves the source
    while the strengths, linear and not negative, are eliminated (variable projection), and shadows are cast anew in
    each step. Only products of light and reflectance are found: see :class:`PointLight`.

    Camera and source are taken to stand still while the head moves, so the light of the first frame holds for the
    others. Several frames of one light may be given together; each turn of the head narrows it down.

    Args:
        frame: what the camera saw, (3,H,W) or (T,3,H,W), sRGB, uint8 or in [0,1].
        vertices: the mesh as it stands in the frame, (V,3) or (T,V,3), millimetres.
        faces: (F,3) int64; all that can hide or shade something.
        albedo: of the vertices, (V,3) sRGB in [0,1], free of shading: from a scan, or from a colour model; see
            ``vertex_albedo``. Taken from the same video it already holds the light, and even light would be the
            answer: that is refused.
        camera: one, or one a frame.
        weights: how much each vertex counts, (V,); 0 leaves out eyes or hair. Equal if absent.
        calibration: of a lens that bends the image; none if absent.

    Returns:
        See :class:`LightFit`. Where the frames show no source, its strength is 0.

    Raises:
        ShapeError: shapes that do not belong together.
        ValueRangeError: NaN in the vertices, a black face, or an albedo that is none or the frame's own.
        AlignmentError: fewer than 60 vertices are to be seen.

    Source: thesis 4.2.11, equation 66 and the objective after it; Golub and Pereyra 1973 (variable projection).
    """
    frames, posed = frame if frame.ndim == 4 else frame[None], vertices if vertices.ndim == 3 else vertices[None]
    cameras = [camera] * len(frames) if isinstance(camera, Camera) else list(camera)
    count = torch.ones(albedo.shape[:1], dtype=torch.float64) if weights is None else weights.detach().cpu().double()
    _check(frames, posed, faces, albedo, cameras, count)
    images = frames.detach().cpu()
    images = images.float() / 255 if images.dtype == torch.uint8 else images.float()
    seen = seen_skin(
        images, posed.detach().cpu(), faces.cpu(), albedo.detach().cpu().float(), cameras, count, calibration
    )
    return _result(seen, find_source(seen), len(frames), len(albedo))


def _result(seen: SeenSkin, fit: SourceFit, frames: int, vertices: int) -> LightFit:
    position = fit.source.position(seen.centre)
    sizes = fit.residuals.norm(dim=1)
    trusted = fit.trust > _OUTLIER
    errors = torch.full((frames, vertices), torch.nan)
    errors[seen.frame, seen.vertex] = sizes.float()
    masks = []
    for mask in (torch.ones_like(trusted), fit.lit > 0, trusted):
        masks.append(torch.zeros(frames, vertices, dtype=torch.bool))
        masks[-1][seen.frame, seen.vertex] = mask
    deviation = math.inf
    if bool((fit.intensity > 0).any()) and bool((fit.lit > 0).any()):
        noise = float((fit.trust * sizes.square()).sum() / (3 * fit.trust.sum()).clamp(min=1))
        H = information(seen, fit)
        covariance = noise * torch.linalg.pinv(H + 1e-12 * torch.eye(3, dtype=H.dtype))
        deviation = math.degrees(math.sqrt(max(float(covariance[:2, :2].trace()), 0.0)))
    light = PointLight(fit.ambient.float(), fit.intensity.float(), position.float())
    return LightFit(light, fit.source.direction.float(), 1 / fit.source.nearness, deviation, errors, *masks)


def _check(
    frames: Tensor, posed: Tensor, faces: Tensor, albedo: Tensor, cameras: Sequence[Camera], weights: Tensor
) -> None:
    if frames.ndim != 4 or frames.shape[1] != 3 or posed.ndim != 3 or posed.shape[2] != 3:
        raise ShapeError(
            f"estimate_light: found frames {tuple(frames.shape)} and vertices {tuple(posed.shape)}, "
            "expected (T,3,H,W) and (T,V,3), or one of each"
        )
    if not len(frames) == len(posed) == len(cameras) or len(frames) == 0:
        raise ShapeError(
            f"estimate_light: found {len(frames)} frames, {len(posed)} meshes and {len(cameras)} cameras, "
            "expected as many of each, at least one"
        )
    for camera in cameras:
        if (camera.height, camera.width) != tuple(frames.shape[2:]):
            raise ShapeError(
                f"frame: found {tuple(frames.shape[2:])} pixels, expected the camera's {(camera.height, camera.width)}"
            )
    if faces.ndim != 2 or faces.shape[1] != 3 or not bool(((faces >= 0) & (faces < posed.shape[1])).all()):
        raise ShapeError(f"faces: found {tuple(faces.shape)}, expected (F,3) of {posed.shape[1]} vertices")
    if albedo.shape != posed.shape[1:] or weights.shape != albedo.shape[:1]:
        raise ShapeError(
            f"albedo: found {tuple(albedo.shape)} with weights {tuple(weights.shape)}, expected "
            f"{tuple(posed.shape[1:])} and {(posed.shape[1],)}"
        )
    if not bool(torch.isfinite(posed).all()):
        raise ValueRangeError("vertices: found NaN or infinity, expected a mesh in every frame")
    if frames.dtype != torch.uint8 and not bool(((frames >= 0) & (frames <= 1)).all()):
        raise ValueRangeError("frame: found values outside of [0,1] or NaN, expected sRGB in [0,1], or uint8")
    if not bool(((albedo >= 0) & (albedo <= 1)).all()):
        raise ValueRangeError("albedo: found values outside of [0,1] or NaN, expected sRGB in [0,1]")
    if not bool((weights >= 0).all()) or not bool(torch.isfinite(weights).all()):
        raise ValueRangeError("weights: found negative or not finite numbers, expected non-negative ones")
