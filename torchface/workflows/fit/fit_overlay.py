"""A fitted head drawn over the photograph that it was fitted to."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.mesh import Mesh
from torchface.modeling import ImageFit
from torchface.rendering.clay_shading import Lighting, render, sample_texture
from torchface.rendering.raycast import RayCaster

_OVER, _MARGIN, _SHARE = 480, 0.45, 0.7
_LIGHT = Lighting(occlusion_rays=0)
_FOUND, _FIT = (0.1, 1.0, 0.2), (1.0, 0.1, 0.1)


def overlay(fit: ImageFit, view: int, image: Tensor, marks: Tensor) -> Tensor:
    """A photograph, the fit over it, and the landmarks: found green, fitted red; (3,H,W), cut to the head.

    Args:
        fit: of I photographs.
        view: which of them.
        image: it, (3,H,W).
        marks: its landmarks, (68,2).
    """
    camera, corner = _cut(fit.cameras[view], marks)
    piece = _sampled(image, corner)
    mesh = fit.posed
    drawn = render(_clay(mesh), camera, lighting=_LIGHT, samples=1)
    origins, directions = camera.rays()
    caster = RayCaster(mesh.vertices, mesh.faces)
    hit = (caster.cast(origins.reshape(-1, 3), directions.reshape(-1, 3)).triangle >= 0).view(_OVER, _OVER)
    over = torch.where(hit, (1 - _SHARE) * piece + _SHARE * drawn, piece)
    dotted = piece
    for points, color in ((marks, _FOUND), (fit.landmarks[view], _FIT)):
        dotted = _dotted(dotted, (points - corner[:2]) * corner[2], color)
    return torch.cat([piece, over, dotted], dim=2)


def _clay(mesh: Mesh) -> Mesh:
    """The bare form: what the photographs gave would hide where the form is wrong."""
    return Mesh(mesh.vertices, mesh.faces)


def _cut(camera: Camera, marks: Tensor) -> tuple[Camera, Tensor]:
    """The camera of a square piece around the landmarks, and where that lies: left, top, pixels of it a pixel (3,)."""
    known = marks[torch.isfinite(marks).all(-1)]
    low, high = known.amin(0), known.amax(0)
    side = float((high - low).max()) * (1 + 2 * _MARGIN)
    corner, scale = (low + high) / 2 - side / 2, _OVER / side
    zoom = torch.eye(3, dtype=torch.float64)
    zoom[0, 0] = zoom[1, 1] = scale
    zoom[:2, 2] = -corner * scale
    piece = Camera(zoom @ camera.intrinsics, camera.rotation, camera.translation, _OVER, _OVER)
    return piece, torch.cat([corner, torch.tensor([scale], dtype=torch.float64)])


def _sampled(image: Tensor, piece: Tensor) -> Tensor:
    steps = torch.arange(_OVER, dtype=torch.float64) / piece[2]
    y, x = torch.meshgrid(steps + piece[1], steps + piece[0], indexing="ij")
    height, width = image.shape[1:]
    uv = torch.stack([(x + 0.5) / width, 1 - (y + 0.5) / height], dim=-1).reshape(-1, 2)
    return sample_texture(image, uv).T.reshape(3, _OVER, _OVER)


def _dotted(image: Tensor, points: Tensor, color: tuple[float, float, float]) -> Tensor:
    """The image with a dot of three pixels at each point (L,2)."""
    spots = points[torch.isfinite(points).all(-1)].round().long()
    spots = spots[((spots >= 1) & (spots < _OVER - 1)).all(-1)]
    step = torch.tensor([-1, 0, 1])
    y = (spots[:, 1, None, None] + step[:, None]).expand(-1, 3, 3).flatten()
    x = (spots[:, 0, None, None] + step[None, :]).expand(-1, 3, 3).flatten()
    image = image.clone()
    image[:, y, x] = torch.tensor(color)[:, None]
    return image
