"""The texture of a scan: three photographs side by side; a triangle is coloured by the one that sees it best."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.geometry.meshes.operators import corners, triangle_normals
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import Lighting, render
from torchface.rendering.raycast import RayCaster

_YAWS = (0.0, -55.0, 55.0)
_FLASH = Lighting(lights=(((0.3, 0.3, 0.9), 0.35), ((-0.4, 0.1, 0.8), 0.2)), ambient=0.5, occlusion_rays=0, gloss=0.03)


@dataclass(frozen=True)
class Photography:
    """How images are taken: ``height`` pixels that cover ``span`` millimetres."""

    height: int = 900
    span: float = 330.0


def photographed(scan: Mesh, subject: Mesh, centre: Tensor, photography: Photography) -> Mesh:
    """A scan with a texture and texture coordinates.

    Args:
        scan: the fused surface, in the subject's place.
        subject: what stood before the cameras, with colours or a texture.
        centre: of the face, (3,).
        photography: how images are taken.
    """
    width = round(photography.height * 0.8)
    cameras = [look_at(centre, yaw, 0.0, photography.span, width, photography.height) for yaw in _YAWS]
    texture = torch.cat([render(subject, camera, lighting=_FLASH, samples=1) for camera in cameras], dim=2)
    best = _best_view(scan, cameras)
    pixels = torch.stack([camera.project(scan.vertices.double()) for camera in cameras])
    wide = texture.shape[2]
    u = (pixels[..., 0].clamp(0, width - 1) + 0.5 + width * torch.arange(len(cameras))[:, None]) / wide
    v = 1 - (pixels[..., 1].clamp(0, photography.height - 1) + 0.5) / photography.height
    uvs = torch.stack([u, v], dim=-1).float()
    rows = scan.faces + best[:, None] * len(scan.vertices)
    used, uv_faces = rows.unique(return_inverse=True)
    return replace(scan, texture=texture, uvs=uvs.view(-1, 2)[used], uv_faces=uv_faces)


def _best_view(scan: Mesh, cameras: list[Camera]) -> Tensor:
    """The camera (F,) that sees a triangle most frontally, one whose view is free before one whose view is not."""
    middle = torch.stack(corners(scan.vertices.double(), scan.faces)).mean(0)
    normals = triangle_normals(scan.vertices.double(), scan.faces)
    caster = RayCaster(scan.vertices, scan.faces)
    scores = []
    for camera in cameras:
        toward = torch.nn.functional.normalize(camera.centre.double() - middle, dim=-1)
        hidden = caster.occluded(middle + 0.5 * normals + 0.5 * toward, toward)
        scores.append((normals * toward).sum(-1) - 2.0 * hidden)
    return torch.stack(scores).argmax(0)
