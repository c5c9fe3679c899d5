"""The solved face drawn over its video: a shaded mesh with the landmarks, or a new texture under the video's light."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.capture.own_rig.face_points import FacePoints
from torchface.capture.own_rig.lighting import PointLight, estimate_light
from torchface.errors import ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io.images.image_files import load_paint
from torchface.mesh import Mesh
from torchface.rendering.point_light import vertex_albedo
from torchface.rendering.raycast import RayCaster
from torchface.rendering.texture_overlay import FacePaint, overlay, skin_faces
from torchface.viz.figures.landmark_dots import with_dots
from torchface.workflows.track.track_result import Tracked

_CHUNK = 8
_STRENGTH = 0.6
_LIGHT_FRAMES = 2
_EVEN_SKIN = (0.80, 0.62, 0.53)
_SKIN = (0.62, 0.74, 0.90)
_MAX_SIDE = 480


def mesh_drawer(tracked: Tracked) -> Callable[[int, Tensor], Tensor]:
    """Draws frame number t, uint8 (3,H,W): the mesh half through, found landmarks green, the solved rig's red."""
    solution, rig = tracked.solution, tracked.rig
    weights = solution.weights.detach().to(rig.deltas)
    points = FacePoints.of(rig, rig.neutral.landmarks)  # those of the contour slide, as the solver has them

    def draw(t: int, frame: Tensor) -> Tensor:
        if not tracked.seen[t]:
            return frame
        straight = undistorted(frame, tracked.calibration)
        vertices = rig(weights[t : t + 1])[0].double()
        camera = camera_at(tracked, t)
        shaded = shade_over(straight, vertices, rig.neutral.faces, camera)
        here = weights[t : t + 1].double()
        rows = points.chosen(here, camera.rotation[None], camera.translation[None], camera.intrinsics)[0]
        return with_dots(shaded, tracked.landmarks[t], camera.project(points.at(here)[0, rows]))

    return draw


def paint_drawer(tracked: Tracked, texture: Path) -> Callable[[int, Tensor], Tensor]:
    """Draws frame number t, uint8 (3,H,W), with paint on the face, lit as the video is."""
    rig = tracked.rig
    paint = FacePaint.of(rig.neutral, load_paint(texture))
    light = video_light(tracked) if tracked.light is None else tracked.light
    weights = tracked.solution.weights.detach().to(rig.deltas)

    def draw(t: int, frame: Tensor) -> Tensor:
        if not tracked.seen[t]:
            return frame
        vertices = rig(weights[t : t + 1])[0]
        return overlay(frame, vertices, paint, light, camera_at(tracked, t), tracked.calibration)

    return draw


def video_light(tracked: Tracked) -> PointLight:
    """The light of a video, from some frames spread over it, beside the rig's colours.

    A rig without colours is taken to have skin of one colour: the light's direction is found all the same, its colour
    then holds what the skin differs by.
    """
    rig, visible = tracked.rig, tracked.seen.nonzero()[:, 0]
    wanted = visible[torch.linspace(0, len(visible) - 1, min(_LIGHT_FRAMES, len(visible))).round().long()].tolist()
    frames, at = [], 0
    for chunk in tracked.video.color_chunks(_CHUNK):
        frames += [chunk[t - at] for t in wanted if at <= t < at + len(chunk)]
        at += len(chunk)
        if len(frames) == len(wanted):
            break
    vertices = rig(tracked.solution.weights.detach()[wanted].to(rig.deltas))
    cameras = [camera_at(tracked, t) for t in wanted]
    return light_of(rig.neutral, torch.stack(frames), vertices, cameras, tracked.calibration)


def light_of(
    neutral: Mesh, frames: Tensor, vertices: Tensor, cameras: list[Camera], calibration: CameraCalibration
) -> PointLight:
    """The light of frames (T,3,H,W) that show a mesh as vertices (T,V,3), beside its colours or skin of one colour."""
    try:
        albedo = vertex_albedo(neutral)
    except ValueRangeError:
        albedo = torch.tensor(_EVEN_SKIN).expand(len(neutral.vertices), 3)
    skin = torch.zeros(len(neutral.vertices))
    skin[neutral.faces[skin_faces(neutral)].flatten()] = 1.0
    return estimate_light(frames, vertices, neutral.faces, albedo, cameras, skin, calibration).light


def camera_at(tracked: Tracked, t: int) -> Camera:
    """The camera of frame t, from the rig's space, without distortion."""
    solution, clip = tracked.solution, tracked.video
    return Camera(
        tracked.calibration.intrinsics.double(),
        solution.rotation[t].detach().double(),
        solution.translation[t].detach().double(),
        clip.width,
        clip.height,
    )


def undistorted(frame: Tensor, calibration: CameraCalibration) -> Tensor:
    """What a camera without distortion would have seen, uint8 (3,H,W)."""
    if not calibration.distortion.any():
        return frame
    image = np.ascontiguousarray(frame.permute(1, 2, 0).numpy())
    straight = cv2.undistort(image, calibration.intrinsics.numpy(), calibration.distortion.numpy())
    return torch.from_numpy(straight).permute(2, 0, 1)


def shade_over(frame: Tensor, vertices: Tensor, faces: Tensor, camera: Camera) -> Tensor:
    """A mesh (V,3) drawn half through over a frame, uint8 (3,H,W), lit from the lens."""
    pixels = camera.project(vertices)
    inside = torch.isfinite(pixels).all(1)
    if not inside.any():
        return frame
    height, width = frame.shape[1:]
    low = pixels[inside].amin(0).floor().clamp(min=0).long().tolist()
    high = (pixels[inside].amax(0).ceil() + 1).long().tolist()
    x0, y0, x1, y1 = low[0], low[1], min(high[0], width), min(high[1], height)
    if x1 - x0 < 2 or y1 - y0 < 2:
        return frame
    # Large images are drawn at a part of their resolution: rays cost, and the mesh is shown half through anyway.
    step = max(1, -(-max(x1 - x0, y1 - y0) // _MAX_SIDE))
    part = _part_of(camera, x0, y0, x1, y1, step)
    origins, ways = part.rays()
    origins, ways = origins.reshape(-1, 3), ways.reshape(-1, 3)
    hits = RayCaster(vertices, faces).cast(origins, ways)
    hit = hits.triangle >= 0
    normals = vertex_normals(vertices, faces)[faces[hits.triangle[hit]]]
    normals = torch.nn.functional.normalize((normals * hits.barycentric[hit][..., None]).sum(1), dim=-1)
    light = (normals * ways[hit]).sum(1).abs()
    drawn = torch.zeros(len(ways), 4)
    drawn[hit, :3] = ((0.15 + 0.85 * light)[:, None] * torch.tensor(_SKIN, dtype=torch.float64)).float()
    drawn[hit, 3] = _STRENGTH
    layer = drawn.view(part.height, part.width, 4).permute(2, 0, 1)[None]
    if step > 1:
        layer = torch.nn.functional.interpolate(layer, scale_factor=step, mode="bilinear", align_corners=False)
    layer = layer[0, :, : y1 - y0, : x1 - x0]
    image = frame.clone()
    under = image[:, y0 : y0 + layer.shape[1], x0 : x0 + layer.shape[2]]
    strength = layer[3:]
    colors = layer[:3] / (strength / _STRENGTH).clamp(min=1e-6)
    mixed = under / 255 * (1 - strength) + colors * strength
    under.copy_((255 * mixed.clamp(0, 1)).round())
    return image


def _part_of(camera: Camera, x0: int, y0: int, x1: int, y1: int, step: int) -> Camera:
    """A camera that sees a part of the image at a part of its resolution."""
    scale = torch.tensor([1 / step, 1 / step, 1.0], dtype=torch.float64)
    shifted = camera.intrinsics.double().clone()
    shifted[:2, 2] -= torch.tensor([x0, y0], dtype=torch.float64)
    shrunk = scale[:, None] * shifted
    shrunk[:2, 2] += (scale[:2] - 1) / 2  # the corner, not the centre of the first pixel, stays where it is
    size = (-(-(x1 - x0) // step), -(-(y1 - y0) // step))
    return Camera(shrunk, camera.rotation, camera.translation, *size)
