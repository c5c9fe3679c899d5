"""Openings of the face, ring by ring from the block's border: lids, lips, nostrils, ears, eyeballs."""

import math
from collections.abc import Callable

import numpy as np
import torch
from scipy.interpolate import CubicSpline, PchipInterpolator
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
    open_share = (1 - spread**3).clamp(min=0.0)
    # Close behind the lips, then out into the cheeks, so that teeth and gums have their place.
    for drop, back, wide in (
        (0.9, 2.6, 1.0), (4.0, 4.6, 1.0), (9.0, 5.6, 1.03), (14.0, 8.0, 1.10),
        (19.0, 18.0, 1.30), (20.0, 34.0, 1.40), (14.0, 54.0, 1.20),
    ):  # fmt: skip
        loop = line.clone()
        loop[:, 0] *= wide
        loop[:, 1] += sign * (drop * open_share + 0.2 * drop * (sign != 0))
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


# The ear's outline round its middle, seen from its side: bearing (degrees, 0 forward, 90 up), then millimetres forward
# and up, how free it stands of the head (0 grown on, 1 free), and how strong the rolled rim is there.
_EAR_OUTLINE = np.array([
    (-65, 7.0, -24.0, 0.0, 0.0), (-35, 11.0, -12.5, 0.0, 0.0), (0, 12.5, 0.0, 0.0, 0.0), (28, 13.0, 9.0, 0.0, 0.5),
    (58, 10.0, 20.5, 0.2, 1.0), (80, 4.5, 28.5, 0.6, 1.0), (102, -5.0, 30.5, 0.95, 1.0), (126, -13.5, 25.0, 1.0, 1.0),
    (153, -18.5, 14.0, 1.0, 1.0), (185, -19.0, 1.0, 1.0, 0.95), (213, -15.5, -10.5, 1.0, 0.8),
    (240, -10.5, -20.5, 0.8, 0.35), (262, -4.5, -28.0, 0.42, 0.0), (280, 1.5, -29.0, 0.15, 0.0),
    (295, 7.0, -24.0, 0.0, 0.0),
])  # fmt: skip
_ANTIHELIX = ((-2.0, -14.5), (-8.0, -8.5), (-10.5, 0.0), (-9.5, 8.0), (-6.5, 14.0), (-2.5, 21.0))
_LOWER_CRUS = ((-8.5, 10.5), (-3.0, 13.0), (4.0, 14.0))
_HELIX_ROOT = ((12.5, 8.0), (7.5, 3.0), (1.5, 1.0))
_EAR_SHELL = (0.92, 0.82, 0.71, 0.58, 0.43, 0.27)
"""How far from the middle to the outline the rings of the ear's front lie."""


def _ridge(spots: Tensor, line: tuple[tuple[float, float], ...], width: float) -> Tensor:
    """1 on a line of points in the ear's plane, falling off over a width, for spots (...,2)."""
    knots = torch.tensor(line, dtype=spots.dtype)
    way = knots[1:] - knots[:-1]
    along = (((spots[..., None, :] - knots[:-1]) * way).sum(-1) / (way**2).sum(-1)).clamp(0, 1)
    near = (spots[..., None, :] - knots[:-1] - along[..., None] * way).norm(dim=-1).amin(-1)
    return torch.exp(-((near / width) ** 2))


def _hump(spots: Tensor, forward: float, up: float, wide: float, tall: float) -> Tensor:
    return torch.exp(-(((spots[..., 0] - forward) / wide) ** 2) - ((spots[..., 1] - up) / tall) ** 2)


def _ear_relief(spots: Tensor, inside: Tensor, rolled: Tensor) -> Tensor:
    """How far the ear's front stands out of the head's side, at spots (K,L,2): rim, furrow, inner ridge, bowl, flaps.

    ``inside`` (K,L) is how far within the outline, mm; ``rolled`` (L,) how strong the rim is.
    """
    plane = 8.0 - 0.42 * spots[..., 0] - 0.22 * (-14 - spots[..., 1]).clamp(min=0)
    rim = rolled * (2.6 * torch.exp(-(((inside - 2.2) / 1.7) ** 2)) - 2.6 * torch.exp(-(((inside - 6.3) / 2.0) ** 2)))
    inner = 2.6 * _ridge(spots, _ANTIHELIX, 2.7) + 1.7 * _ridge(spots, _LOWER_CRUS, 2.2)
    bowl = 10.5 * _hump(spots, 1.0, -4.5, 6.0, 7.5) + 6.0 * _hump(spots, 2.5, 7.0, 7.0, 3.6)
    flaps = 6.0 * _hump(spots, 10.5, -3.5, 3.4, 4.8) + 2.4 * _hump(spots, -0.5, -15.5, 3.6, 3.0)
    return plane + rim + inner - bowl + flaps + 3.2 * _ridge(spots, _HELIX_ROOT, 2.4) + _hump(spots, 0, -24, 6, 5)


def _evenly(bearing: Tensor) -> Tensor:
    """Bearings (L,), degrees, moved so that points on the ear's outline are nearly as far from each other."""
    dense = np.linspace(-65, 295, 721)
    length = np.concatenate(
        [
            [0],
            np.cumsum(
                np.linalg.norm(
                    np.diff(CubicSpline(_EAR_OUTLINE[:, 0], _EAR_OUTLINE[:, 1:3], bc_type="periodic")(dense), axis=0),
                    axis=1,
                )
            ),
        ]
    )
    turns, rest = np.divmod(bearing.numpy() + 65, 360)
    place = turns + np.interp(rest - 65, dense, length) / length[-1]
    step = np.sign(place[-1] - place[0]) / len(place)
    even = step * np.arange(len(place))
    place = 0.15 * place + 0.85 * (even + (place - even).mean())
    return torch.from_numpy(np.interp((place % 1) * length[-1], length, dense))


def ear_rings(border: Tensor, onto_form: OntoForm) -> Tensor:
    """Rings (11,L,3): three up the shell's back, the edge, six over its front into the bowl."""
    del onto_form
    lean = math.radians(14)
    upward = torch.tensor([0.0, math.cos(lean), -math.sin(lean)]).double()
    forward = torch.tensor([0.0, math.sin(lean), math.cos(lean)]).double()
    centre = torch.tensor([0.0, -13.0, -9.5]).double()
    offset = border - border.mean(0)
    bearing = torch.rad2deg(torch.atan2(offset @ upward / 1.7, offset @ forward))
    bearing = _evenly(torch.from_numpy(np.unwrap(bearing.numpy(), period=360)))
    curve = CubicSpline(_EAR_OUTLINE[:, 0], _EAR_OUTLINE[:, 1:3], bc_type="periodic")
    outline = torch.from_numpy(curve(bearing.numpy()))
    free, rolled = torch.from_numpy(PchipInterpolator(_EAR_OUTLINE[:, 0], _EAR_OUTLINE[:, 3:])(bearing.numpy())).T
    outline[:, 1] *= 1.064
    middle = torch.tensor([0.0, -2.0]).double()
    shares = torch.tensor((1.0, *_EAR_SHELL)).double()[:, None, None]
    spots = middle + shares * (outline - middle)
    inside = (1 - shares[..., 0]) * (outline - middle).norm(dim=-1)
    relief = _ear_relief(spots, inside, rolled)
    # Where the ear grows out of the cheek its edge lies on the head.
    relief = relief - (1 - free) * (relief[:1] - 0.6) * torch.exp(-inside / 5.0)
    relief[0] -= 1.0 * free
    edge = relief[0]
    behind = torch.stack([middle + share * (outline - middle) for share in (0.34, 0.56, 1.0)])
    start = torch.stack([(border - centre) @ forward, (border - centre) @ upward], 1)
    before = torch.stack([share * outline + (1 - share) * start for share in (0.3, 0.6, 0.85)])
    up_the_back = torch.stack([0.0 * edge, 0.5 * edge, edge - 3.0])
    level = torch.tensor([0.0, 0.1, 0.3]).double()[:, None]
    spots = torch.cat([behind * free[:, None] + before * (1 - free)[:, None], spots])
    height = torch.cat([up_the_back * free + level * (1 - free), relief])
    keeps = torch.tensor([1.0, 0.95, 0.9, 0.85, 0.75, 0.6, 0.45, 0.3, 0.2, 0.1]).double()[:, None]
    root = 67.0 + (border[:, 0] - 67.0) * (1 - free) * keeps
    placed = centre + spots[..., :1] * forward + spots[..., 1:] * upward
    placed[..., 0] = root + height
    rings = torch.cat([border[None], placed])
    for _ in range(4):  # evens out where the shell's back begins
        around = (rings[1:4].roll(1, 1) + rings[1:4].roll(-1, 1)) / 2
        around[:2] = (around[:2] + (rings[:2] + rings[2:4]) / 2) / 2
        rings[1:4] = 0.5 * rings[1:4] + 0.5 * around
    return rings


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
