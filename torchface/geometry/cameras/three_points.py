"""The poses that three points leave open: the perspective-three-point problem in closed form."""

from __future__ import annotations

import torch
from torch import Tensor

_POLISH = 3
_TINY = 1e-30


def three_point_poses(points: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    r"""The up to four poses in which a camera sees three points along three rays.

    The distances :math:`s_i` along the rays obey :math:`s_i^2 + s_j^2 - 2 s_i s_j f_i^\top f_j = \lVert x_i - x_j
    \rVert^2`; their ratio :math:`s_3 / s_1` is a root of a quartic. Of complex roots, which noise makes of double
    real ones, the real part is taken; then and for points on a line the pose is an approximation or NaN. Meant for
    hypotheses by the ten thousand: everything is batched.

    Args:
        points: x, (...,3,3), one a row, millimetres.
        rays: f, (...,3,3), the directions in which the camera sees them, of any length.

    Returns:
        Rotations (...,4,3,3) and translations (...,4,3), world to camera.

    Source: Grunert 1841, as in Haralick, Lee, Ottenberg, Nölle 1994.
    """
    f = torch.nn.functional.normalize(rays, dim=-1)
    a, b, c = (
        (points[..., i, :] - points[..., j, :]).square().sum(-1, keepdim=True) for i, j in ((1, 2), (0, 2), (0, 1))
    )
    alpha, beta, gamma = ((f[..., i, :] * f[..., j, :]).sum(-1, keepdim=True) for i, j in ((1, 2), (0, 2), (0, 1)))
    v = _real_roots(_quartic(a / b, c / b, alpha, beta, gamma))
    q = (a - c) / b
    u = ((q - 1) * v.square() - 2 * q * beta * v + 1 + q) / (2 * (gamma - v * alpha))
    s = (b / (1 + v.square() - 2 * v * beta)).sqrt()
    seen = torch.stack([s, u * s, v * s], dim=-1)[..., None] * f[..., None, :, :]
    rotation = _axes(seen) @ _axes(points)[..., None, :, :].transpose(-1, -2)
    moved = (rotation @ points.mean(-2)[..., None, :, None])[..., 0]
    return rotation, seen.mean(-2) - moved


def _quartic(a: Tensor, c: Tensor, alpha: Tensor, beta: Tensor, gamma: Tensor) -> tuple[Tensor, ...]:
    """Coefficients of v⁴, v³, v², v, 1; ``a`` and ``c`` in units of b."""
    q, both = a - c, a + c
    return (
        (q - 1).square() - 4 * c * alpha.square(),
        4 * (q * (1 - q) * beta - (1 - both) * alpha * gamma + 2 * c * alpha.square() * beta),
        2
        * (
            q.square()
            - 1
            + 2 * q.square() * beta.square()
            + 2 * (1 - c) * alpha.square()
            - 4 * both * alpha * beta * gamma
            + 2 * (1 - a) * gamma.square()
        ),
        4 * (-q * (1 + q) * beta + 2 * a * gamma.square() * beta - (1 - both) * alpha * gamma),
        (1 + q).square() - 4 * a * gamma.square(),
    )


def _real_roots(quartic: tuple[Tensor, ...]) -> Tensor:
    """Real parts (...,4) of the roots by Ferrari's formula, polished by Newton's method."""
    leading = quartic[0]
    leading = torch.where(leading.abs() < 1e-12, 1e-12, leading)
    b, c, d, e = (coefficient / leading for coefficient in quartic[1:])
    # The depressed quartic y⁴ + p y² + q y + r of v = y - b/4, and its resolvent m³ + p m² + (p²/4 - r) m - q²/8.
    p = c - 3 / 8 * b.square()
    q = d - b * c / 2 + b**3 / 8
    r = e - b * d / 4 + b.square() * c / 16 - 3 / 256 * b**4
    third = (p.square() / 4 - r) - p.square() / 3
    last = 2 * p**3 / 27 - p * (p.square() / 4 - r) / 3 - q.square() / 8
    root = torch.complex(last.square() / 4 + third**3 / 27, torch.zeros_like(last)).sqrt()
    # Of both cubes the larger loses no digits.
    cube = torch.where(last > 0, -last / 2 - root.real, -last / 2 + root.real) + 1j * root.imag
    w = torch.polar(cube.abs().clamp(min=_TINY) ** (1 / 3), cube.angle() / 3)
    m = w - third / (3 * w) - p / 3
    twice = (2 * m).sqrt()
    side = q / torch.where(twice.abs() < 1e-12, 1e-12 + 0j, twice)
    roots = [
        0.5 * (sign * twice + other * (-(2 * p + 2 * m + sign * 2 * side)).sqrt())
        for sign in (1.0, -1.0)
        for other in (1.0, -1.0)
    ]
    v = torch.cat(roots, dim=-1).real - b / 4
    for _ in range(_POLISH):
        value = (((v + b) * v + c) * v + d) * v + e
        slope = ((4 * v + 3 * b) * v + 2 * c) * v + d
        step = value / torch.where(slope.abs() < 1e-12, 1e-12, slope)
        v = v - step.clamp(-0.05, 0.05)
    return v


def _axes(triangles: Tensor) -> Tensor:
    """Right-handed axes as columns (...,3,3) that go with triangles (...,3,3)."""
    along = torch.nn.functional.normalize(triangles[..., 1, :] - triangles[..., 0, :], dim=-1)
    across = torch.linalg.cross(along, triangles[..., 2, :] - triangles[..., 0, :])
    normal = torch.nn.functional.normalize(across, dim=-1)
    return torch.stack([along, torch.linalg.cross(normal, along), normal], dim=-1)
