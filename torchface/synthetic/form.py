"""The mean head's outer form as a signed distance: ellipsoids and round cones, smoothly joined and cut.

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
        # Skull.
        Ellipsoid((0, 38, -16), (75, 74, 79), 1),
        Ellipsoid((0, 42, 26), (60, 58, 66), 25),
        Ellipsoid((0, -5, 18), (64, 70, 66), 25),
        # Neck, and the muscle that runs from behind the ear to the throat.
        RoundCone((0, -60, -26), (0, -200, -34), 50, 55, 22),
        RoundCone((0, -20, -50), (0, -120, -52), 34, 30, 30),
        RoundCone((54, -50, -18), (18, -190, 14), 13, 11, 18),
        # Lower face: muzzle, jaw from chin to angle to joint, cheek.
        Ellipsoid((0, -62, 51), (38, 44, 40), 18),
        RoundCone((13, -98, 70), (44, -72, 14), 12, 13, 14),
        RoundCone((44, -72, 14), (57, -18, 8), 12.5, 10, 16),
        Ellipsoid((33, -54, 42), (27, 34, 28), 20),
        Ellipsoid((0, -100, 74), (17, 13, 15.5), 12),
        # Cheekbone from beside the nose to the ear; brow ridge.
        RoundCone((36, -24, 66), (56, -16, 44), 12, 9, 18),
        RoundCone((56, -16, 44), (64, -10, 14), 8.5, 5.5, 14),
        RoundCone((7, 13, 85), (30, 18, 80), 8, 8, 12),
        RoundCone((30, 18, 80), (50, 8, 61), 8, 7, 12),
        Ellipsoid((0, 20, 82), (18, 14, 12), 14),
        # Orbit, then the lids over the eyeball.
        Ellipsoid((x - 1.5, y + 1.0, 87), (17, 12.5, 13.5), 11, cut=True),
        Ellipsoid((17, 1, 90), (7, 10, 9), 8, cut=True),
        Ellipsoid((x, y, z), (lid + 0.6, lid, lid), 4.5),
        # Temple.
        Ellipsoid((74, 22, 52), (14, 26, 22), 16, cut=True),
        # Nose: bridge, tip, wings, the partition between the nostrils.
        RoundCone((0, 10, 79), (0, -14, 92), 7.5, 7.0, 9),
        RoundCone((0, -10, 90), (0, -33, 101.5), 7.0, 9.4, 7),
        Ellipsoid((4, -33.5, 102.5), (7.5, 7.5, 8.2), 4),
        Ellipsoid((10.6, -36.8, 93.5), (6.6, 6.6, 9.5), 4),
        RoundCone((0, -39.0, 101), (0, -43, 90), 4.0, 5.0, 4),
        # Groove between nose and lip, hollow above the chin.
        Ellipsoid((0, -86, 98), (22, 7, 12.5), 9, cut=True),
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


def cast(starts: Tensor, directions: Tensor, rounds: int = 40) -> Tensor:
    """Where rays from outside (N,3) along unit directions (N,3) first meet the form, (N,3)."""
    points = starts.clone()
    for _ in range(rounds):  # sphere tracing: each round depends on the last
        points = points + directions * 0.85 * signed_distance(points)[:, None]
    return points


def project(points: Tensor, rounds: int = 3) -> Tensor:
    """Nearby points (N,3) moved onto the form along its gradient."""
    for _ in range(rounds):
        points = points - 0.9 * signed_distance(points)[:, None] * gradient(points)
    return points
