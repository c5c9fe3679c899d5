"""Lines of a face's wrinkles: curves on the skin, with how deep and how wide it folds there."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.mesh import Mesh
from torchface.rendering.raycast import RayCaster
from torchface.synthetic.stages.wrinkles.wrinkle_strokes import Stroke, wrinkle_strokes

_STEP = 0.25  # millimetres between points of a line


@dataclass(frozen=True, eq=False)
class WrinkleLine:
    """A line in which skin folds."""

    place: str  # which wrinkle it is, such as forehead or crows_feet_left
    points: Tensor  # along it on the neutral face, (S,3), a quarter of a millimetre apart
    triangle: Tensor  # rows of the neutral's faces, (S,) int64, that the points lie on
    barycentric: Tensor  # weights of the corners of those triangles, (S,3)
    depth: float  # of the valley below the ridges at full compression, millimetres
    width: float  # from the valley's bottom to where its sides end, millimetres
    trace: float  # share of the depth that is there at rest
    overhang: float = 0.0  # how much the upper or outer ridge hangs over the valley; 0 for a symmetric fold


def wrinkle_lines(neutral: Mesh, seed: int) -> list[WrinkleLine]:
    """All the lines of a dense face, y up, z toward the viewer; left and right differ."""
    chart = _Chart(neutral)
    marks = chart.flat(neutral.vertices[neutral.landmarks].double())
    lines = (chart.lay(stroke) for stroke in wrinkle_strokes(marks, seed))
    return [line for line in lines if line is not None]


class _Chart:
    """The face unrolled from a cylinder that stands between the ears: millimetres round it, and up."""

    def __init__(self, neutral: Mesh) -> None:
        marks = neutral.vertices[neutral.landmarks].double()
        self.mesh, self.caster = neutral, RayCaster(neutral.vertices, neutral.faces)
        self.axis = float(marks[[0, 16], 2].mean())
        self.radius = float((marks[[36, 45], 2] - self.axis).mean() ** 2 + marks[[36, 45], 0].square().mean()) ** 0.5

    def flat(self, points: Tensor) -> Tensor:
        angle = torch.atan2(points[:, 0], points[:, 2] - self.axis)
        return torch.stack([self.radius * angle, points[:, 1]], dim=1).float()

    def lay(self, stroke: Stroke) -> WrinkleLine | None:
        """The stroke on the skin, or nothing where the face has none."""
        flat = _spline(stroke.control.double())
        angle, up = flat[:, 0] / self.radius, flat[:, 1]
        way = torch.stack([angle.sin(), torch.zeros_like(up), angle.cos()], dim=1)
        foot = torch.stack([torch.zeros_like(up), up, torch.full_like(up, self.axis)], dim=1)
        hits = self.caster.cast(foot + 3 * self.radius * way, -way)
        there = hits.triangle >= 0
        if int(there.sum()) < 8:
            return None
        triangle, barycentric = hits.triangle[there], hits.barycentric[there].double()
        corner = self.mesh.vertices[self.mesh.faces[triangle]].double()
        points = (corner * barycentric[..., None]).sum(1)
        length = (points[1:] - points[:-1]).norm(dim=1).cumsum(0)
        stops = torch.arange(0, float(length[-1]), _STEP, dtype=torch.float64)
        keep = torch.searchsorted(length, stops)
        return WrinkleLine(
            stroke.place, points[keep], triangle[keep], barycentric[keep],
            stroke.depth, stroke.width, stroke.trace, stroke.overhang,
        )  # fmt: skip


def _spline(control: Tensor) -> Tensor:
    """A smooth curve (S,2) through control points (K,2), much finer than a line. Source: Catmull and Rom 1974."""
    padded = torch.cat([2 * control[:1] - control[1:2], control, 2 * control[-1:] - control[-2:-1]])
    t = torch.linspace(0, 1, 64, dtype=control.dtype)[:-1, None, None]
    a, b, c, d = padded[:-3], padded[1:-2], padded[2:-1], padded[3:]
    curve = 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
    return torch.cat([curve.transpose(0, 1).flatten(0, 1), control[-1:]])
