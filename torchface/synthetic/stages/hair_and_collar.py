"""Hair and collar of a scanned head: lumps on the scalp, and cloth round the neck."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.meshes.operators import vertex_normals
from torchface.mesh import Mesh

_WAVES = 14
_HAIRLINE = 62.0  # millimetres above the eyes, on the forehead
_HAIR_COLOR, _COLLAR_COLOR = (0.12, 0.09, 0.07), (0.75, 0.78, 0.80)


@dataclass(frozen=True)
class Dress:
    """How much of it there is."""

    hair: float = 9.0  # thickness of the lumps, millimetres; 0 is a shaved head
    collar: float = 10.0  # thickness of the collar's lumps, millimetres; 0 is none


def dressed(head: Mesh, landmarks: Tensor, dress: Dress, generator: torch.Generator) -> Mesh:
    """A head with colours, fine enough to carry lumps, in its own space (y up, z forward), with hair and collar."""
    vertices = head.vertices.double()
    colors = torch.full_like(vertices, 0.7) if head.colors is None else head.colors.double()
    eyes, chin, ears = landmarks[36:48].mean(0), landmarks[8], landmarks[[0, 16]].mean(0)
    share = _hair_share(vertices, eyes, ears)
    lumps = _lumps(vertices, generator, 22.0, 70.0)
    thickness = dress.hair * share * (1.0 + 0.45 * lumps)
    vertices = vertices + thickness[:, None] * vertex_normals(vertices, head.faces)
    colors = torch.lerp(colors, torch.tensor(_HAIR_COLOR, dtype=torch.float64), share[:, None] ** 0.5)
    faces = head.faces
    if dress.collar > 0:
        ring, ring_faces = _collar(vertices, ears, chin, dress.collar, generator)
        faces = torch.cat([faces, ring_faces + len(vertices)])
        vertices = torch.cat([vertices, ring])
        colors = torch.cat([colors, torch.tensor(_COLLAR_COLOR, dtype=torch.float64).expand(len(ring), 3)])
    return Mesh(vertices.float(), faces, colors=colors.clamp(0, 1).float())


def _hair_share(vertices: Tensor, eyes: Tensor, ears: Tensor) -> Tensor:
    """0 on the face, 1 on the scalp, (V,); the line falls from forehead to behind the ears."""
    depth = ((eyes[2] - vertices[:, 2]) / (eyes[2] - ears[2]).clamp(min=20)).clamp(-1, 2)
    # On the forehead the line lies far above the eyes, at the ears a little above them, behind them far below.
    line = eyes[1] + _HAIRLINE - 45.0 * depth.clamp(min=0) - 75.0 * (depth - 1.15).clamp(min=0) / 0.5
    return ((vertices[:, 1] - line) / 9.0).clamp(0, 1) * (vertices[:, 1] > ears[1] - 90)


def _lumps(points: Tensor, generator: torch.Generator, shortest: float, longest: float) -> Tensor:
    """A smooth random field of about unit size, (N,)."""
    heading = torch.nn.functional.normalize(torch.randn(_WAVES, 3, generator=generator, dtype=torch.float64), dim=-1)
    draw = torch.rand(_WAVES, 2, generator=generator, dtype=torch.float64)
    length = shortest * (longest / shortest) ** draw[:, 0]
    phase = points @ (heading * (2 * math.pi / length)[:, None]).T + 2 * math.pi * draw[:, 1]
    return phase.sin().sum(1) * math.sqrt(2 / _WAVES)


def _collar(
    vertices: Tensor, ears: Tensor, chin: Tensor, thickness: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """A crumpled band round the neck, open in front, (N,3) and its faces."""
    top = chin[1] - 48.0
    neck = vertices[(vertices[:, 1] - top).abs() < 12]
    centre = neck[:, [0, 2]].mean(0) if len(neck) else torch.stack([ears[0], ears[2]])
    reach = (neck[:, [0, 2]] - centre).norm(dim=1).quantile(0.9) if len(neck) else torch.tensor(60.0)
    rows, columns = 12, 120
    angle = torch.linspace(0.35, 2 * math.pi - 0.35, columns, dtype=torch.float64)  # 0 is in front
    down = torch.linspace(0, 1, rows, dtype=torch.float64)
    radius = reach + 6.0 + 22.0 * down[:, None] ** 1.5
    x, z = centre[0] + radius * angle.sin(), centre[1] + radius * angle.cos()
    y = top - 30.0 * down[:, None] + 14.0 * (1 - angle.cos()) / 2
    ring = torch.stack([x, y.expand(rows, columns), z], dim=-1).view(-1, 3)
    ring = ring + (0.3 * thickness * _lumps(ring, generator, 12.0, 50.0))[:, None] * torch.nn.functional.normalize(
        ring - torch.stack([centre[0], top, centre[1]]), dim=-1
    )
    grid = torch.arange(rows * columns).view(rows, columns)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    faces = torch.cat([torch.stack([a, b, c], -1).view(-1, 3), torch.stack([a, c, d], -1).view(-1, 3)])
    return ring, faces
