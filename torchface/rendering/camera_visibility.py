"""Visibility of a head's vertices in a photograph, and how squarely they are seen."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.distortion import distort
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import vertex_normals
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import sample_texture
from torchface.rendering.raycast import RayCaster

_OFF_THE_SKIN = 0.2  # millimetres; a ray that starts on the skin would hit it


@dataclass(frozen=True, eq=False)
class Shown:
    """Points (Q,) in one photograph."""

    # Between the normal and the way to the camera, (Q,); 0 where the point is hidden or outside the image.
    cosine: Tensor
    colors: Tensor  # of the image there, (Q,3), bilinear


@dataclass(frozen=True, eq=False)
class PosedSurface:
    """A mesh as a photograph shows it: vertices (V,3) and unit normals (V,3), float64 on the CPU, and what rays hit."""

    vertices: Tensor
    normals: Tensor
    caster: RayCaster

    @staticmethod
    def each(posed: Mesh | Sequence[Mesh], count: int) -> "list[PosedSurface]":
        """One a photograph: of a mesh that all of them show, or of one for each."""
        meshes = [posed] if isinstance(posed, Mesh) else list(posed)
        if len(meshes) not in (1, count):
            raise ShapeError(f"posed: found {len(meshes)} meshes for {count} photographs, expected one, or one each")
        surfaces = []
        for mesh in meshes:
            vertices, faces = mesh.vertices.detach().cpu().double(), mesh.faces.cpu()
            surfaces.append(PosedSurface(vertices, vertex_normals(vertices, faces), RayCaster(vertices, faces)))
        return surfaces * (count if len(meshes) == 1 else 1)

    def shown_in(self, image: Tensor, camera: Camera) -> Shown:
        """What a photograph (3,H,W) shows at the vertices."""
        return shown_in(image.cpu(), camera, self.caster, self.vertices, self.normals)


def shown_in(
    image: Tensor,
    camera: Camera,
    caster: RayCaster,
    points: Tensor,
    normals: Tensor,
    calibration: CameraCalibration | None = None,
) -> Shown:
    """What a photograph (3,H,W) shows at points (Q,3) with normals (Q,3)."""
    if image.ndim != 3 or image.shape != (3, camera.height, camera.width):
        raise ShapeError(f"images: found {tuple(image.shape)}, expected (3,{camera.height},{camera.width})")
    points, normals = points.double(), normals.double()
    toward = torch.nn.functional.normalize(camera.centre.double() - points, dim=-1)
    cosine = (toward * normals).sum(-1).clamp(min=0)
    depth = points @ camera.rotation.double()[2] + camera.translation.double()[2]
    pixels = camera.project(points)
    limit = torch.tensor([camera.width - 1, camera.height - 1], dtype=torch.float64)
    if calibration is not None:
        pixels = distort(pixels, calibration)
    within = ((pixels >= 0) & (pixels <= limit)).all(-1) & (depth > 0)
    asked = (within & (cosine > 0)).nonzero()[:, 0]
    starts = points[asked] + _OFF_THE_SKIN * (normals[asked] + toward[asked])
    hidden = caster.occluded(starts, toward[asked])
    result = torch.zeros_like(cosine)
    result[asked[~hidden]] = cosine[asked[~hidden]]
    uv = (torch.nan_to_num(pixels) + 0.5) / (limit + 1)
    return Shown(result, sample_texture(image, torch.stack([uv[:, 0], 1 - uv[:, 1]], dim=-1)))
