"""The sculpture's outer form as a signed distance: ellipsoids and round cones, smoothly joined and cut.

The eyes are closed and the lips absent here; the mesh cuts its openings and lays the lips on (``sculpt``).
Origin: on the midline at pupil height, above the ear canals; y up, z forward, millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

EYE_CENTRE = (31.5, 0.0, 66.5)
EYE_RADIUS = 13.2
LID_THICKNESS = 1.5


@dataclass(frozen=True)
class Ellipsoid:
    """Centre and radii, joined to what comes before over about ``blend`` millimetres; ``cut`` takes it away."""

    centre: tuple[float, float, float]
    radii: tuple[float, float, float]
    blend: float
    cut: bool = False


@dataclass(frozen=True)
class RoundCone:
    """A bone-like body from ``start`` with radius ``thick`` to ``end`` with radius ``thin``."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    thick: float
    thin: float
    blend: float
    cut: bool = False


def _blend_head() -> tuple[Ellipsoid | RoundCone, ...]:
    """Order matters: each body is joined to the union of those before it."""
    x, y, z = EYE_CENTRE
    lid = EYE_RADIUS + LID_THICKNESS
    return (
        # Skull and face.
        Ellipsoid((0, 38, -16), (75, 74, 79), 1),
        Ellipsoid((0, 45, 26), (62, 60, 66), 40),
        Ellipsoid((0, -5, 18), (57.5, 72, 64), 40),
        # Neck, and the muscle that runs from behind the ear to the throat.
        RoundCone((0, -70, -14), (0, -200, -36), 46, 52, 30),
        RoundCone((0, -10, -46), (0, -130, -52), 36, 36, 40),
        RoundCone((48, -50, -20), (16, -190, 12), 9, 10, 26),
        RoundCone((56, -8, -18), (52, -38, -18), 11, 9, 26),
        # Upper jaw, muzzle, lower jaw from chin to angle to joint, chewing muscle, cheek.
        Ellipsoid((0, -32, 45), (44, 42, 41), 25),
        Ellipsoid((0, -64, 51), (35, 40, 40), 24),
        RoundCone((13, -98, 70), (34.5, -75, 14), 12, 13, 22),
        RoundCone((34.5, -75, 14), (51, -18, 8), 12.0, 9, 22),
        Ellipsoid((37, -48, 24), (14, 32, 28), 24),
        Ellipsoid((32, -48, 42), (27, 36, 32), 26),
        Ellipsoid((0, -101.5, 73.5), (18, 14, 15.5), 16),
        # Cheekbone from beside the nose to the ear; brow ridge.
        RoundCone((35, -22, 60), (52, -14, 42), 13.5, 10.5, 26),
        RoundCone((52, -14, 42), (55, -8, 12), 9.5, 6.5, 24),
        RoundCone((8, 18, 79), (28, 23, 76), 9, 10, 22),
        RoundCone((28, 22, 76), (49, 13, 57), 10, 9, 22),
        Ellipsoid((0, 18, 80), (18, 16, 14), 18),
        # Orbit, then the lids over the eyeball.
        Ellipsoid((x - 1.5, y + 0.5, 88.5), (17.5, 11.5, 12.5), 20, cut=True),
        Ellipsoid((17, 0, 91), (6.5, 9, 8), 16, cut=True),
        Ellipsoid((x, y, z), (lid + 0.8, lid, lid), 7),
        # Temple.
        Ellipsoid((79, 24, 54), (14, 26, 22), 26, cut=True),
        # Nose: bridge, sides, tip, wings, the partition between the nostrils.
        RoundCone((0, 10, 78), (0, -14, 91), 8.0, 7.2, 12),
        RoundCone((0, -10, 90), (0, -32.8, 103.3), 7.2, 9.0, 9),
        RoundCone((4, -4, 81), (8.0, -31, 89), 5, 7.2, 9),
        Ellipsoid((3.8, -33.0, 105.9), (7.2, 7.2, 8.0), 6),
        Ellipsoid((12.2, -37.0, 93.0), (5.8, 6.2, 9.0), 3.5),
        RoundCone((0, -38.5, 101.5), (0, -41.0, 87), 3.8, 4.2, 3.5),
        # Hollow above the chin.
        Ellipsoid((0, -86.5, 99), (24, 7, 12.5), 13, cut=True),
    )


@lru_cache(maxsize=1)
def _tables() -> tuple[Tensor, ...]:
    bodies = _blend_head()
    ball = [b for b in bodies if isinstance(b, Ellipsoid)]
    cone = [b for b in bodies if isinstance(b, RoundCone)]
    as_tensor = lambda rows: torch.tensor(rows, dtype=torch.float64)  # noqa: E731
    return (
        as_tensor([b.centre for b in ball]),
        as_tensor([b.radii for b in ball]),
        as_tensor([c.start for c in cone]),
        as_tensor([c.end for c in cone]),
        as_tensor([[c.thick, c.thin] for c in cone]),
    )


def signed_distance(points: Tensor) -> Tensor:
    """Signed distance (N,), approximate away from the surface, negative inside; points (N,3) float64."""
    centre, radii, start, end, thickness = _tables()
    # A rounded |x|: mirrored bodies meet on the midline without a ridge.
    folded = torch.cat([(points[:, :1] ** 2 + 4.0).sqrt() - 0.6, points[:, 1:]], dim=1)
    offset = folded[:, None] - centre
    k0 = (offset / radii).norm(dim=-1)
    k1 = (offset / radii**2).norm(dim=-1).clamp(min=1e-9)
    balls = iter((k0 * (k0 - 1) / k1).unbind(1))
    axis = end - start
    along = (((folded[:, None] - start) * axis).sum(-1) / (axis**2).sum(-1)).clamp(0, 1)
    radius = thickness[:, 0] + along * (thickness[:, 1] - thickness[:, 0])
    cones = iter(((folded[:, None] - start - along[..., None] * axis).norm(dim=-1) - radius).unbind(1))
    result: Tensor | None = None
    for body in _blend_head():
        distance = next(balls) if isinstance(body, Ellipsoid) else next(cones)
        if result is None:
            result = distance
        elif body.cut:
            result = -_smooth_minimum(-result, distance, body.blend)
        else:
            result = _smooth_minimum(result, distance, body.blend)
    assert result is not None
    return result


def _smooth_minimum(a: Tensor, b: Tensor, width: float) -> Tensor:
    overlap = (width - (a - b).abs()).clamp(min=0)
    return torch.minimum(a, b) - overlap**3 / (6 * width**2)


def gradient(points: Tensor, step: float = 0.05) -> Tensor:
    """Outward unit normals (N,3) by central differences over a tetrahedron."""
    corner = torch.tensor([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], dtype=points.dtype)
    probes = (points[:, None] + step * corner).reshape(-1, 3)
    total = (signed_distance(probes).view(-1, 4, 1) * corner).sum(1)
    return torch.nn.functional.normalize(total, dim=-1)


def cast(starts: Tensor, directions: Tensor, iterations: int = 40) -> Tensor:
    """Where rays from outside (N,3) along unit directions (N,3) first meet the form, (N,3)."""
    points = starts.clone()
    for _ in range(iterations):  # sphere tracing: each iteration depends on the last
        points = points + directions * 0.85 * signed_distance(points)[:, None]
    return points


def project(points: Tensor, iterations: int = 3) -> Tensor:
    """Nearby points (N,3) moved onto the form along its gradient."""
    for _ in range(iterations):
        points = points - 0.9 * signed_distance(points)[:, None] * gradient(points)
    return points
