"""Openings of the face, ring by ring from the block's border: lids, lips, nostrils, ears, eyeballs."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from torchface.synthetic.head.signed_distance import EYE_CENTRE, EYE_RADIUS, gradient, project
from torchface.synthetic.head.topology import EYE_RIM, MOUTH_BORDER, MOUTH_CONTACT

OntoForm = Callable[[Tensor], Tensor]
LID_SHARES = (0.0, 0.22, 0.42, 0.58, 0.71, 0.81, 0.89, 0.95, 1.0)
LIP_SHARES = (0.0, 0.3, 0.55, 0.75, 0.9, 1.0)
"""How far along from the block's border to the lid's edge or the red of the lips each loop of skin lies."""

UPPER_LID = 16  # edges along each lid; along each half lip there are 13
HALF_LIP = 13
MEDIAL_CORNER = 29
MOUTH_HALF_WIDTH = 25.5
STOMION_HEIGHT = -66.5


def _pchip(at: Tensor, knots: list[float], values: list[float]) -> Tensor:
    return torch.from_numpy(PchipInterpolator(knots, values)(at.numpy()))


def lid_order() -> tuple[Tensor, Tensor]:
    """Ring positions along the upper and the lower lid from the inner to the outer corner, each (17,)."""
    step = torch.arange(UPPER_LID + 1)
    return (MEDIAL_CORNER + step) % 32, (MEDIAL_CORNER - step) % 32


def _lid_rim() -> Tensor:
    """The opening's edge seen from in front, (32,2), in ring order."""
    tau = torch.arange(UPPER_LID + 1).double() / UPPER_LID
    tau = 0.75 * tau + 0.25 * (1 - (math.pi * tau).cos()) / 2
    x = EYE_CENTRE[0] - 15.3 + 30.6 * tau
    base = -2.6 + 3.0 * tau
    upper = base + _pchip(tau, [0, 0.08, 0.22, 0.42, 0.62, 0.82, 1], [0, 1.9, 4.2, 5.7, 5.4, 3.2, 0])
    lower = base - _pchip(tau, [0, 0.08, 0.22, 0.42, 0.66, 0.86, 1], [0, 1.3, 2.5, 3.8, 4.2, 2.4, 0])
    rim = torch.zeros(32, 2, dtype=torch.float64)
    above, below = lid_order()
    rim[below] = torch.stack([x, lower], 1)
    rim[above] = torch.stack([x, upper], 1)
    return rim


def eye_rings(border: Tensor, onto_form: OntoForm) -> Tensor:
    """Rings (16,32,3): skin over the orbit, upper crease, lid edge, inner lid, a socket behind the eyeball."""
    rim = _lid_rim()
    share = torch.tensor(LID_SHARES).double()[:, None, None]
    edge = onto_form(torch.cat([rim, torch.full((32, 1), 78.0, dtype=rim.dtype)], dim=1))
    laid = border * (1 - share) + edge * share
    skin = onto_form(laid[1:].reshape(-1, 3)).view(EYE_RIM, 32, 3)
    centre = torch.tensor(EYE_CENTRE).double()
    # The fold over the upper lid: a furrow with an overhang above it, strongest in the middle of the lid.
    above, _ = lid_order()
    strength = torch.zeros(32, dtype=torch.float64)
    strength[above] = (math.pi * torch.arange(UPPER_LID + 1).double() / UPPER_LID).sin() ** 0.7
    outward = torch.nn.functional.normalize(skin - centre, dim=-1)
    depth = torch.tensor([0.0, 0.4, 0.9, 0.9, -1.7, -0.5, 0.0, 0.0]).double()[:, None]
    skin = skin + outward * (depth * strength)[..., None]
    rings = [border[None], skin]
    edge = skin[-1]
    # The lid is thick: its inner edge lies against the eyeball, and at the corners a little behind the outer edge.
    out = edge - centre
    inner = out * (((EYE_RADIUS + 0.3) / out.norm(dim=-1, keepdim=True)).clamp(max=1.0))
    inner[:, 2] -= 0.4 * (out.norm(dim=-1) < EYE_RADIUS + 0.6)
    outside = (out[:, :2].norm(dim=-1) / EYE_RADIUS).clamp(min=1) - 1
    inner[:, 2] -= 5 * outside
    inner = inner * ((EYE_RADIUS + 0.3) / inner.norm(dim=-1, keepdim=True)).clamp(min=1.0)
    rings.append((centre + inner)[None])
    # Six loops over the eyeball, from the inner edge to behind its equator.
    azimuth = torch.atan2(inner[:, 1], inner[:, 0])
    start = torch.acos((inner[:, 2] / inner.norm(dim=-1)).clamp(-1, 1))
    even = torch.atan2(azimuth.sin(), azimuth.cos() * 0.8)
    for k in range(1, EYE_SOCKET_RINGS + 1):
        share_k = k / EYE_SOCKET_RINGS
        polar = start + (2.55 - start) * share_k
        angle = azimuth + share_k * (even - azimuth)
        radius = EYE_RADIUS + 0.3 + 1.2 * share_k
        loop = torch.stack([polar.sin() * angle.cos(), polar.sin() * angle.sin(), polar.cos()], 1) * radius
        rings.append((centre + loop)[None])
    return torch.cat(rings)


EYE_SOCKET_RINGS = 6


def lip_order() -> tuple[Tensor, Tensor]:
    """Ring positions along the upper and the lower lip from the midline to the corner, each (14,)."""
    step = torch.arange(HALF_LIP + 1)
    return step, 2 * HALF_LIP - step


def contact_line(x: Tensor) -> tuple[Tensor, Tensor]:
    """Height and depth where the lips meet, at a distance from the midline."""
    share = (x.abs() / MOUTH_HALF_WIDTH).clamp(max=1.1)
    height = STOMION_HEIGHT - 0.5 * torch.exp(-((x / 4.0) ** 2)) + 0.5 * torch.exp(-(((x.abs() - 10) / 6) ** 2))
    return height - 0.8 * share**3, 91.8 - 12.5 * share**2.2


def mouth_rings(border: Tensor, onto_form: OntoForm) -> Tensor:
    """Half rings (17,27,3): skin, border of the red, lips, where they touch, inner lips, the mouth's bag."""
    upper, lower = lip_order()
    s = torch.arange(HALF_LIP + 1).double() / HALF_LIP
    s = 0.7 * s + 0.3 * (s * math.pi / 2).sin()
    x = MOUTH_HALF_WIDTH * s
    line_y, line_z = contact_line(x)
    red = torch.zeros(27, 2, dtype=torch.float64)
    knots = [0.0, 0.12, 0.24, 0.45, 0.7, 0.9, 1.0]
    red[lower] = torch.stack([x * 1.035, _pchip(s, knots, [-76.6, -76.6, -76.4, -75.2, -72.2, -69.2, -67.4])], 1)
    red[upper] = torch.stack([x * 1.035, _pchip(s, knots, [-59.1, -58.5, -57.9, -59.3, -62.6, -65.6, -67.4])], 1)
    share = torch.tensor(LIP_SHARES).double()[:, None, None]
    edge = onto_form(torch.cat([red, 92 - 0.02 * red[:, :1] ** 2], dim=1))
    skin = onto_form((border * (1 - share) + edge * share)[1:].reshape(-1, 3)).view(MOUTH_BORDER, 27, 3)
    is_upper = torch.arange(27) < HALF_LIP
    spread = torch.zeros(27, dtype=torch.float64)
    spread[upper], spread[lower] = s, s
    fullness = (1 - spread**2.2).clamp(min=0)
    # The skin rises to a soft edge at the border of the red; the groove under the nose is two low ridges.
    lift = torch.tensor([0.0, 0.05, 0.2, 0.55, 1.0]).double()[:, None]
    skin[..., 2] += lift * fullness * torch.where(is_upper, 1.6, 0.6)
    skin[..., 2] += _philtrum(skin)
    line = torch.zeros(27, 3, dtype=torch.float64)
    for order, gap in ((lower, -0.06), (upper, 0.06)):
        line[order] = torch.stack([x, line_y + gap * (1 - s**4), line_z], 1)
    rings = [border[None], skin]
    edge = skin[-1]
    bulge = torch.where(is_upper, 3.0, 4.3) * (0.12 + 0.88 * fullness)
    middle = torch.exp(-((edge[:, 0] / 4.5) ** 2)) * is_upper * 0.8
    for tau in (0.30, 0.60, 0.85, 1.0):
        loop = edge * (1 - tau) + line * tau
        swell = 4 * tau * (1 - tau) * (1.0 + 0.35 * (tau - 0.5))
        loop[:, 2] += swell * (bulge + middle)
        rings.append(loop[None])
    rings[-1] = line[None]
    sign = torch.where(is_upper, 1.0, -1.0).double()
    sign[HALF_LIP] = 0.0
    open_share = 1 - spread**3
    for drop, back, narrow in (
        (0.9, 2.6, 1.0), (3.5, 6.0, 0.99), (8.0, 10.0, 0.97), (13.0, 16.0, 0.95),
        (16.0, 24.0, 0.92), (16.0, 34.0, 0.86), (13.0, 44.0, 0.72),
    ):  # fmt: skip
        loop = line.clone()
        loop[:, 0] *= narrow
        loop[:, 1] += sign * (drop * open_share.clamp(min=0.0) + 0.2 * drop * (sign != 0))
        loop[:, 2] -= back
        rings.append(loop[None])
    assert len(rings) - 1 + MOUTH_BORDER - 1 == MOUTH_CONTACT + 7
    return torch.cat(rings)


def _philtrum(points: Tensor) -> Tensor:
    x, y = points[..., 0], points[..., 1]
    tall = torch.exp(-(((y + 53) / 6.5) ** 4))
    return tall * (0.8 * torch.exp(-(((x - 5.2) / 2.4) ** 2)) - 1.0 * torch.exp(-((x / 3.0) ** 2)))


def nostril_rings(border: Tensor, onto_form: OntoForm) -> Tensor:
    """Rings (6,12,3): the nose's underside, the nostril's edge, a tube going up inside."""
    del onto_form
    # An oval that points from the wing's base to the tip, in the plane of the nose's underside.
    centre = torch.tensor([7.6, -43.0, 97.0]).double()
    along = torch.nn.functional.normalize(torch.tensor([-0.50, -0.02, 0.86]).double(), dim=0)
    across = torch.nn.functional.normalize(torch.tensor([0.85, 0.15, 0.50]).double(), dim=0)
    middle = border.mean(0)
    angle = torch.atan2((border - middle) @ along, (border - middle) @ across)
    edge = centre + 2.7 * angle.cos()[:, None] * across + 4.8 * angle.sin()[:, None] * along
    edge = project(edge, 4)
    between = project(0.5 * border + 0.5 * edge, 3)
    between = between + 0.5 * gradient(between)
    up = torch.nn.functional.normalize(torch.tensor([-0.15, 0.95, -0.2]).double(), dim=0)
    rings = [border, between, edge]
    for rise, shrink in ((1.2, 0.86), (4.0, 0.75), (7.5, 0.5)):
        rings.append(edge.mean(0) + (edge - edge.mean(0)) * shrink + rise * up)
    return torch.stack(rings)


def ear_rings(border: Tensor, onto_form: OntoForm) -> Tensor:
    """Rings (11,L,3): root, back of the shell, rim, fold, inner ridge, bowl."""
    del onto_form
    lean = math.radians(14)
    upward = torch.tensor([0.0, math.cos(lean), -math.sin(lean)]).double()
    forward = torch.tensor([0.0, math.sin(lean), math.cos(lean)]).double()
    outward = torch.tensor([1.0, 0.0, 0.0]).double()
    centre = torch.tensor([0.0, -13.0, -9.5]).double()
    offset = border - border.mean(0)
    angle = torch.atan2(offset @ upward / 1.7, offset @ forward)
    sine, cosine = angle.sin(), angle.cos()
    back = ((0.35 - cosine) / 1.35).clamp(0, 1) ** 0.8  # 0 where the ear grows from the cheek, 1 at its free edge
    tall = 36.6 * sine
    wide = 17.5 * cosine * (1 + 0.22 * sine) - 1.5 * sine
    lobe = (-sine - 0.45).clamp(min=0) / 0.55
    rim = 16.5 * back * (1 - 0.45 * lobe) + 1.2 * (1 - back)
    hollow = 1 - lobe
    rings = [border]
    base = border @ outward  # the head under the ear
    for size, height in (
        (0.62, 0.0 * rim), (0.64, 0.45 * rim), (0.96, 0.92 * rim), (1.0, rim + 1.0), (0.93, rim + 1.8),
        (0.85, rim - 2.4 * hollow), (0.68, 0.80 * rim + 0.6 + 1.2 * hollow), (0.56, 0.62 * rim + 0.5),
        (0.46, 0.42 * rim - 4.0 * hollow), (0.30, 0.28 * rim - 6.0),
    ):  # fmt: skip
        # In front the ear grows out of the cheek: there each loop lies inside the one before.
        reach = size * back + (1 - back) * min(size, 0.98 - 0.045 * len(rings))
        spot = centre + (reach * tall)[:, None] * upward + (reach * wide)[:, None] * forward
        root = 67.0 + 0.65 * (base - 67.0) * (1 - back)
        spot[:, 0] = root + height
        rings.append(spot)
    return torch.stack(rings)


def eyeball_points(loops: Tensor, front: Tensor, back: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The left eyeball with its cornea: loops (K,S,3) and the grids that close it in front and behind."""
    count, segments = loops.shape
    # Clockwise seen from in front, starting at the upper left as closing grids do.
    angle = 0.75 * math.pi - 2 * math.pi * torch.arange(segments).double() / segments
    polar = torch.linspace(0.20, math.pi - 0.28, count, dtype=torch.float64)[:, None].expand(count, segments)
    ring = _on_eyeball(polar, angle.expand(count, segments))
    grids = []
    for grid, sign in ((front, 1.0), (back, -1.0)):
        side = grid.shape[0]
        u = torch.linspace(-1, 1, side, dtype=torch.float64)
        across, down = torch.meshgrid(u, u, indexing="xy")
        reach = torch.maximum(across.abs(), down.abs())
        bearing = _square_bearing(across, down)
        angle = reach * (0.20 if sign > 0 else 0.28)
        angle = angle if sign > 0 else math.pi - angle
        bearing = bearing if sign > 0 else math.pi - bearing
        grids.append(_on_eyeball(angle, bearing))
    return ring, grids[0], grids[1]


def _square_bearing(across: Tensor, down: Tensor) -> Tensor:
    """The angle that a square's border point takes when the square is bent into a circle with even spacing."""
    a, d = across, -down
    horizontal = a.abs() >= d.abs()
    part = torch.where(horizontal, d / a.abs().clamp(min=1e-9), a / d.abs().clamp(min=1e-9)) * math.pi / 4
    right = torch.where(a >= 0, part, math.pi - part)
    above = torch.where(d >= 0, math.pi / 2 - part, -math.pi / 2 + part)
    return torch.where(horizontal, right, above)


def _on_eyeball(polar: Tensor, angle: Tensor) -> Tensor:
    cornea = 0.9 * ((0.52 - polar) / 0.52).clamp(0, 1) ** 1.2
    radius = EYE_RADIUS - 0.15 + cornea * 0.25
    way = torch.stack([polar.sin() * angle.cos(), polar.sin() * angle.sin(), polar.cos()], dim=-1)
    return torch.tensor(EYE_CENTRE).double() + radius[..., None] * way
