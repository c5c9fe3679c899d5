"""Identity of a head: measurable parameters, each a smooth field over the sculpture."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.synthetic.head.sculpture import sculpture
from torchface.synthetic.head.signed_distance import EYE_CENTRE, EYE_RADIUS
from torchface.synthetic.head.topology import EYE_RIM, MOUTH_BORDER, topology

HINGE = (57.0, -14.0, 8.0)  # the left jaw joint of the sculpture

Field = Callable[[Tensor, "_Parts"], Tensor]


@dataclass(frozen=True)
class IdentityParameter:
    """One way in which heads differ.

    Args:
        name: of the parameter.
        description: what is measured, and its unit.
        mean: of the measurement on the mean head; 0 where the parameter is an offset from the mean.
        standard_deviation: of the measurement over the population, same unit.

    Example:
        >>> IDENTITY[0].name, IDENTITY[0].description
        ('head_length', 'glabella to the back of the head, mm')
    """

    name: str
    description: str
    mean: float
    standard_deviation: float


@dataclass(frozen=True, eq=False)
class Anatomy:
    """One head before its mesh is dressed: vertices (V,3), eye centres (2,3) left first, radius, jaw joints (2,3)."""

    vertices: Tensor
    eye_centres: Tensor
    eye_radius: Tensor
    hinges: Tensor


@dataclass(frozen=True, eq=False)
class _Parts:
    """Masks (V+4,) over the vertices and the four probe points: two eye centres, two jaw joints."""

    ear: Tensor
    upper_lip: Tensor
    lower_lip: Tensor
    lips_ring: Tensor


def ramp(values: Tensor, start: float, end: float) -> Tensor:
    """A smooth step from 0 at ``start`` to 1 at ``end``."""
    t = ((values - start) / (end - start)).clamp(0, 1)
    return t * t * t * (t * (6 * t - 15) + 10)


def bump(points: Tensor, centre: tuple[float, float, float], width: tuple[float, float, float]) -> Tensor:
    """A Gaussian (N,) round a point of the left side and its mirror image."""
    folded = torch.cat([points[:, :1].abs(), points[:, 1:]], dim=1)
    offset = (folded - torch.tensor(centre, dtype=points.dtype)) / torch.tensor(width, dtype=points.dtype)
    return torch.exp(-0.5 * (offset**2).sum(1))


def _along(axis: int, amount: Tensor) -> Tensor:
    moved = torch.zeros(len(amount), 3, dtype=amount.dtype)
    moved[:, axis] = amount
    return moved


def _front(p: Tensor) -> Tensor:
    return ramp(p[:, 2], 0, 50)


def _nose(p: Tensor) -> Tensor:
    """1 on the nose's lower half, falling over the cheeks."""
    x = p[:, 0].abs()
    return (1 - ramp(x, 19, 36)) * ramp(p[:, 1], -58, -46) * (1 - ramp(p[:, 1], -28, -4)) * ramp(p[:, 2], 50, 80)


def _mouth(p: Tensor) -> Tensor:
    x = p[:, 0].abs()
    return (1 - ramp(x, 27, 52)) * ramp(p[:, 1], -100, -80) * (1 - ramp(p[:, 1], -56, -42)) * ramp(p[:, 2], 20, 65)


def _out(p: Tensor) -> Tensor:
    return torch.nn.functional.normalize(p - torch.tensor([0.0, -20.0, -10.0], dtype=p.dtype), dim=1)


def _side(p: Tensor) -> Tensor:
    return torch.tanh(p[:, 0] / 4.0)


def _cheeks(p: Tensor, _: _Parts) -> Tensor:
    fat = bump(p, (42, -55, 45), (18, 24, 24)) + 0.7 * bump(p, (28, -112, 40), (26, 12, 26))
    return _out(p) * (fat + 0.35 * bump(p, (34, -24, 68), (16, 13, 20)))[:, None]


def _ear_scale(p: Tensor, parts: _Parts) -> Tensor:
    root = torch.stack([p[:, 0].sign() * 68, torch.full_like(p[:, 0], -13.0), torch.full_like(p[:, 0], -8.0)], 1)
    return (p - root) / 53.0 * parts.ear[:, None]


def _ear_turn(p: Tensor, parts: _Parts) -> Tensor:
    return _along(0, p[:, 0].sign() * ramp(-p[:, 2], -8, 24) * parts.ear)


def _lip(sign: float, p: Tensor, lip: Tensor) -> Tensor:
    reach = (1 - (p[:, 0].abs() / 26).clamp(max=1) ** 2) * lip
    return torch.stack([torch.zeros_like(reach), 0.9 * sign * reach, 0.35 * reach], dim=1)


_FIELDS: tuple[tuple[str, str, float, float, Field], ...] = (
    ("head_length", "glabella to the back of the head, mm", 190, 6.5,
     lambda p, _: _along(2, (p[:, 2] - 95) / 190 * ramp(p[:, 1], -170, -40))),
    ("head_width", "greatest width of the skull, mm", 152, 5.5,
     lambda p, _: _along(0, p[:, 0] / 152 * ramp(p[:, 1], -60, 20) * (1 - ramp(p[:, 2], 30, 90)))),
    ("head_height", "height of the crown above the pupils, mm", 113, 5.0,
     lambda p, _: _along(1, (p[:, 1] - 30).clamp(min=0) ** 1.4 / 83**1.4)),
    ("face_width", "width across the cheekbones, mm", 137, 5.5,
     lambda p, _: _along(0, 0.5 * p[:, 0].sign() * ramp(p[:, 0].abs(), 14, 60) * ramp(p[:, 2], -60, 10)
                         * torch.exp(-(((p[:, 1] + 12) / 48) ** 4)))),
    ("jaw_width", "width across the angles of the jaw, mm", 105, 5.0,
     lambda p, _: _along(0, 0.5 * p[:, 0].sign() * ramp(p[:, 0].abs(), 8, 46)
                         * torch.exp(-(((p[:, 1] + 80) / 36) ** 2)) * ramp(p[:, 2], -40, 5))),
    ("jaw_angle", "height of the angle of the jaw, mm from the mean", 0, 3.0,
     lambda p, _: _along(1, bump(p, (48, -78, 12), (18, 18, 24)))),
    ("face_height", "nasion to the lowest point of the chin, mm", 120, 5.0,
     lambda p, _: _along(1, p[:, 1].clamp(-116, 30) / 120 * _front(p))),
    ("chin_height", "height of the chin below the lips, mm from the mean", 0, 2.2,
     lambda p, _: _along(1, -ramp(-p[:, 1], 76, 106) * _front(p))),
    ("chin_protrusion", "how far the chin stands forward, mm from the mean", 0, 2.4,
     lambda p, _: _along(2, bump(p, (0, -102, 88), (26, 17, 40)))),
    ("chin_width", "half the width of the chin, mm from the mean", 0, 1.8,
     lambda p, _: _along(0, _side(p) * bump(p, (18, -102, 76), (12, 14, 22)))),
    ("nose_length", "nasion to the base of the nose, mm", 50, 2.4,
     lambda p, _: _along(1, -ramp(-p[:, 1], -7, 41) * _front(p))),
    ("nose_width", "width across the wings, mm", 35, 1.9,
     lambda p, _: _along(0, p[:, 0] / 35 * _nose(p))),
    ("nose_protrusion", "tip in front of the base, mm", 19, 1.4,
     lambda p, _: _along(2, bump(p, (0, -34, 113), (15, 13, 10)) * 1.14)),
    ("nose_bridge", "how high the back of the nose stands, mm from the mean", 0, 1.3,
     lambda p, _: _along(2, bump(p, (0, -11, 96), (8, 12, 14)))),
    ("nose_root", "depth of the nasion, mm from the mean", 0, 1.2,
     lambda p, _: _along(2, bump(p, (0, 6, 87), (11, 11, 14)))),
    ("nose_bridge_width", "half the width of the bridge, mm from the mean", 0, 0.7,
     lambda p, _: _along(0, _side(p) * bump(p, (8, -8, 88), (6, 16, 12)))),
    ("nose_tip_turn", "how far the tip is turned up, mm from the mean", 0, 1.6,
     lambda p, _: _along(1, bump(p, (0, -37, 110), (13, 11, 11)))),
    ("nose_tip_size", "half the breadth of the tip, mm from the mean", 0, 0.7,
     lambda p, _: (p - torch.tensor([0.0, -35.0, 103.0])) / 9 * bump(p, (0, -35, 106), (12, 11, 11))[:, None]),
    ("pupil_distance", "between the pupils, mm", 63, 2.8,
     lambda p, _: _along(0, 0.5 * torch.tanh(p[:, 0] / 10) * bump(p, (31.5, 0, 72), (24, 24, 40)))),
    ("eye_depth", "how far the eyes stand forward, mm from the mean", 0, 1.2,
     lambda p, _: _along(2, bump(p, (31.5, 0, 76), (17, 14, 30)))),
    ("brow_ridge", "how far the brows stand forward, mm from the mean", 0, 1.5,
     lambda p, _: _along(2, bump(p, (24, 18, 86), (20, 9, 25)))),
    ("brow_height", "height of the brows, mm from the mean", 0, 1.7,
     lambda p, _: _along(1, bump(p, (28, 22, 82), (26, 10, 40)))),
    ("forehead_slope", "how far the hairline lies back, mm from the mean", 0, 3.0,
     lambda p, _: _along(2, -ramp(p[:, 1], 20, 85) * ramp(p[:, 2], -20, 70))),
    ("temple_fullness", "fullness beside the brows, mm from the mean", 0, 1.6,
     lambda p, _: _out(p) * bump(p, (62, 22, 48), (14, 20, 20))[:, None]),
    ("cheekbones", "how far the cheekbones stand out, mm from the mean", 0, 2.0,
     lambda p, _: _out(p) * bump(p, (50, -18, 58), (15, 12, 18))[:, None]),
    ("cheek_fullness", "fat of cheeks and throat, mm from the mean", 0, 3.0, _cheeks),
    ("muzzle", "how far mouth and teeth stand forward, mm from the mean", 0, 1.6,
     lambda p, _: _along(2, bump(p, (0, -64, 90), (26, 17, 34)))),
    ("mouth_width", "between the corners of the mouth, mm", 51, 2.8,
     lambda p, _: _along(0, p[:, 0].clamp(-30, 30) / 51 * _mouth(p))),
    ("mouth_height", "height of the mouth below the nose, mm from the mean", 0, 1.4,
     lambda p, _: _along(1, -ramp(-p[:, 1], 44, 57) * (1 - ramp(-p[:, 1], 76, 100)) * ramp(p[:, 2], 5, 50))),
    ("upper_lip", "height of the red of the upper lip, mm from the mean", 0, 0.9,
     lambda p, parts: _lip(1.0, p, parts.upper_lip)),
    ("lower_lip", "height of the red of the lower lip, mm from the mean", 0, 1.0,
     lambda p, parts: _lip(-1.0, p, parts.lower_lip)),
    ("lip_fullness", "how far the red of the lips bulges, mm from the mean", 0, 0.8,
     lambda p, parts: _along(2, parts.lips_ring * (1 - (p[:, 0].abs() / 26).clamp(max=1) ** 2))),
    ("ear_size", "height of the ear, mm", 62, 3.2, _ear_scale),
    ("ear_protrusion", "how far the ear's edge stands off, mm from the mean", 0, 2.5, _ear_turn),
    ("neck_width", "width of the neck, mm from the mean", 0, 6.0,
     lambda p, _: torch.cat([p[:, :1], torch.zeros_like(p[:, :1]), p[:, 2:] + 30], 1) / 112
     * ramp(-p[:, 1], 105, 150)[:, None]),
)  # fmt: skip

# What heads have that the sculpture has not, which keeps the place of every point that networks learned: millimetres
# along an axis (0 to the side) about a point of the left side, and how far that reaches. The profile becomes as convex
# as people's (Legan and Burstone 1980: 12 degrees; the sculpture's 4); upper lip and lower lip stand before the base of
# the nose and the fold below them and the chin behind it as far as people's (Arnett et al. 1999: 3.5, 1.5, -6 and -3).
_PROPORTIONS: tuple[tuple[int, float, tuple[float, float, float], tuple[float, float, float]], ...] = (
    (2, -4.8, (0, -104, 86), (22, 11, 40)),  # the chin stands behind the lips
    (1, 1.6, (0, -111, 74), (24, 12, 30)),
    (2, 1.8, (0, -54.5, 92), (20, 7, 25)),  # the skin between nose and lip before the bones
    (2, 2.8, (0, -50.5, 90), (13, 4.4, 25)),
    (2, 0.8, (0, -34, 113), (15, 13, 10)),  # the tip of the nose
    (2, -1.5, (0, -69, 95), (15, 5, 25)),  # the lower lip behind the upper one
    (2, 1.2, (0, -83, 86), (18, 5, 30)),
    (0, 2.4, (60, -14, 24), (22, 24, 16)),  # the face before the ears
    (0, 1.4, (50, -45, 20), (12, 18, 22)),
    (0, -1.6, (47, -60, 34), (12, 14, 16)),  # the cheek beside the mouth
    (0, 1.2, (66, 24, 42), (12, 18, 20)),  # the temple
    (2, -1.3, (0, 50, 88), (40, 24, 40)),  # the forehead
    (2, -1.8, (0, 13, 88), (10, 10, 20)),
    (2, 4.2, (30, 11.0, 78), (19, 5.5, 30)),  # the fold between brow and lid
    (2, 2.0, (50, 18, 70), (9, 12, 25)),
    (2, -1.8, (31, 26, 86), (14, 6, 30)),  # the ridge above it
    (2, -1.6, (9, 1, 90), (4, 9, 14)),  # the sides of the bridge
)
_LID_STAYS = torch.tensor([0.0, 0.0, 0.0, 0.1, 0.4, 0.85] + [1.0] * 10, dtype=torch.float64)  # a ring round the eye
_OFFSETS = {"brow_height": 3.0, "lip_fullness": 0.6, "eye_opening": 0.5}  # millimetres

# These four move lids and eyeball only; their fields are placed on the lid rings below.
_EYE_PARAMETERS: tuple[tuple[str, str, float, float], ...] = (
    ("eye_width", "length of the opening between the lids, mm", 30, 1.3),
    ("eye_opening", "height of the opening between the lids, mm from the mean", 0, 0.75),
    ("eye_slant", "height of the outer corner over the inner, mm from the mean", 0, 1.2),
    ("eye_size", "radius of the eyeball, mm", EYE_RADIUS, 0.35),
)

IDENTITY: tuple[IdentityParameter, ...] = tuple(
    IdentityParameter(name, description, mean, deviation)
    for name, description, mean, deviation in (*(row[:4] for row in _FIELDS), *_EYE_PARAMETERS)
)
"""Every way in which heads differ; coefficients are in standard deviations."""

LID_SHARE = torch.tensor([0.0, 0.15, 0.4, 0.7, 0.9] + [1.0] * 11, dtype=torch.float64)


@lru_cache(maxsize=1)
def sculpted_vertices() -> Tensor:
    """The sculpture, (V,3) float64: where skin is painted, hair is rooted and the points of networks have their places.

    The mean head of people is ``anatomy()``.
    """
    t = topology()
    half = sculpture().vertices
    whole = torch.zeros(t.count, 3, dtype=torch.float64)
    whole[t.other_half] = half * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    whole[: t.half_count] = half
    return whole


def mirrored(delta: Tensor) -> Tensor:
    """A displacement (V,3) of the left side as one of the right."""
    return delta[topology().mirror] * torch.tensor([-1.0, 1.0, 1.0], dtype=delta.dtype)


def both_sides(half_ids: Tensor) -> tuple[Tensor, Tensor]:
    """Vertex ids of a left part and of its mirror image."""
    return half_ids, topology().mirror[half_ids]


@lru_cache(maxsize=1)
def _proportions() -> Tensor:
    """From the sculpture's vertices and probes to the mean head's, (V+4,3); lids and eyeballs stay."""
    t = topology()
    points = torch.cat([sculpted_vertices(), _probes()])
    moved = torch.zeros_like(points)
    for axis, amount, centre, width in _PROPORTIONS:
        outward = _side(points) if axis == 0 else torch.ones(len(points), dtype=points.dtype)
        moved += _along(axis, amount * outward * bump(points, centre, width))
    still = torch.zeros(len(points), 1, dtype=points.dtype)
    for side in (0, 1):
        still[both_sides(t.rings["eye"])[side]] = _LID_STAYS[:, None, None]
        still[both_sides(t.caps["eye"])[side]] = 1.0
        still[_eyeball_ids(side)] = 1.0
    return (1 - still) * moved


def _probes() -> Tensor:
    """The sculpture's eyes and joints of the jaw, left before right, (4,3)."""
    probes = torch.tensor([EYE_CENTRE, EYE_CENTRE, HINGE, HINGE], dtype=torch.float64)
    probes[1::2, 0] *= -1
    return probes


@lru_cache(maxsize=1)
def _modes() -> tuple[Tensor, Tensor, Tensor]:
    """Displacement a standard deviation (K,V+4,3), lid share (V,), share by which lids keep to the eyeball (V,)."""
    t = topology()
    mean = sculpted_vertices()
    probes = _probes()
    points = torch.cat([mean, probes])
    parts = _parts(len(points))
    modes = torch.stack([field(points, parts) * deviation for _, _, _, deviation, field in _FIELDS])
    modes = torch.cat([modes, torch.zeros(len(_EYE_PARAMETERS), *modes.shape[1:], dtype=modes.dtype)])
    lid = torch.zeros(t.count, dtype=torch.float64)
    keep = torch.zeros(t.count, dtype=torch.float64)
    for side, sign in ((0, 1.0), (1, -1.0)):
        ids = both_sides(t.rings["eye"])[side]
        cap = both_sides(t.caps["eye"])[side]
        ball = _eyeball_ids(side)
        lid[cap] = lid[ball] = 1.0
        lid[ids] = LID_SHARE[:, None].expand(-1, 32)
        centre = modes[:, t.count + side][:, None]
        for whole in (ids.flatten(), cap.flatten(), ball):
            share = lid[whole][None, :, None]
            modes[:, whole] = (1 - share) * modes[:, whole] + share * centre
        offset = mean[ids] - probes[side]
        # Opening, width and slant act on the edge and what is near it; the socket stays with the eyeball.
        reach = torch.tensor([0, 0.1, 0.25, 0.4, 0.55, 0.7, 0.85, 0.95, 1, 1, 0.5, 0.2, 0, 0, 0, 0]).double()[:, None]
        middle = (mean[ids[EYE_RIM, 13], 1] + mean[ids[EYE_RIM, 29], 1]) / 2
        edge = mean[ids[EYE_RIM]] - probes[side]
        tall = (edge[:, 1] - (middle + 0.1 * edge[:, 0] * sign)) / 10.0
        for row, (axis, amount) in enumerate((
            (0, reach * edge[:, 0] / 30 * 1.3),
            (1, reach * tall * 0.75),
            (1, reach * edge[:, 0] * sign / 30 * 1.2),
        )):  # fmt: skip
            modes[len(_FIELDS) + row, ids, axis] += amount
        flat = offset[..., :2].norm(dim=-1)
        keep[ids] = (1 - ramp(flat, EYE_RADIUS - 1.5, EYE_RADIUS + 1.5)) * LID_SHARE[:, None] ** 3
        keep[ids[EYE_RIM + 2 :]] = 1.0
        keep[cap] = keep[ball] = 1.0
    modes = 0.5 * (modes + _reflect(modes))
    return modes, lid, keep


def _reflect(modes: Tensor) -> Tensor:
    t = topology()
    twin = torch.cat([t.mirror, t.count + torch.tensor([1, 0, 3, 2])])
    return modes[:, twin] * torch.tensor([-1.0, 1.0, 1.0], dtype=modes.dtype)


def _eyeball_ids(side: int) -> Tensor:
    t = topology()
    ids = torch.cat([t.eyeball.flatten(), t.caps["eyeball_front"].flatten(), t.caps["eyeball_back"].flatten()]).unique()
    return both_sides(ids)[side]


def _parts(count: int) -> _Parts:
    t = topology()
    ear, upper, lower, ring = (torch.zeros(count, dtype=torch.float64) for _ in range(4))
    share = torch.tensor([0.0, 0.0, 0.1, 0.35, 0.7, 1.0, 0.75, 0.45, 0.15] + [0.0] * 8).double()[:, None]
    swell = torch.tensor([0.0] * 5 + [0.15, 0.75, 1.0, 0.7] + [0.0] * 8).double()[:, None]
    for side in (0, 1):
        rings = both_sides(t.rings["mouth"])[side]
        upper[rings[:, :13]], lower[rings[:, 14:]] = share.expand(-1, 13), share.expand(-1, 13)
        ring[rings] = swell.expand(-1, 27)
        shell = sculpted_vertices()[both_sides(t.rings["ear"])[side]][..., 0].abs()
        free = ramp(shell[4] - shell[0], -6.0, 12.0)  # in front its edge lies on the cheek
        held = torch.tensor([0.0, 0.12, 0.25, 0.4, 0.55, 0.7, 0.85] + [1.0] * 4).double()[:, None]
        grown = torch.tensor([0.0, 0.6, 0.72] + [1.0] * 8).double()[:, None]
        ear[both_sides(t.rings["ear"])[side]] = held + free * (grown - held)
        ear[both_sides(t.caps["ear"])[side]] = 1.0
    assert MOUTH_BORDER == 5
    return _Parts(ear, upper, lower, ring)


def check_identity(identity: Tensor | None) -> Tensor:
    """Coefficients (K,) float64; the mean where none are given."""
    if identity is None:
        return torch.zeros(len(IDENTITY), dtype=torch.float64)
    if identity.shape != (len(IDENTITY),):
        raise ShapeError(f"identity: found {tuple(identity.shape)}, expected ({len(IDENTITY)},)")
    if not torch.isfinite(identity).all():
        raise ValueRangeError("identity: found NaN or infinite coefficients, expected finite standard deviations")
    return identity.detach().cpu().double()


def anatomy(identity: Tensor | None = None) -> Anatomy:
    """The head of these coefficients (K,), in standard deviations."""
    coefficients = check_identity(identity)
    t = topology()
    modes, _, keep = _modes()
    mean = sculpted_vertices()
    offsets = torch.tensor([_OFFSETS.get(one.name, 0.0) / one.standard_deviation for one in IDENTITY]).double()
    moved = _proportions() + torch.einsum("k,kvc->vc", coefficients + offsets, modes)
    vertices = mean + moved[: t.count]
    probes = _probes() + moved[t.count :]
    radius = EYE_RADIUS + coefficients[-1] * IDENTITY[-1].standard_deviation
    # Lids lie on the eyeball however it moved or grew; the eyeball itself stays round.
    for side in (0, 1):
        ball = _eyeball_ids(side)
        ids = torch.cat([both_sides(t.rings["eye"])[side].flatten(), both_sides(t.caps["eye"])[side].flatten()])
        old = mean[ids] - torch.tensor(EYE_CENTRE).double() * torch.tensor([1.0 - 2 * side, 1, 1]).double()
        now = vertices[ids] - probes[side]
        wanted = now * ((old.norm(dim=1) - EYE_RADIUS + radius) / now.norm(dim=1).clamp(min=1e-6))[:, None]
        vertices[ids] = probes[side] + now + keep[ids][:, None] * (wanted - now)
        old_ball = mean[ball] - torch.tensor(EYE_CENTRE).double() * torch.tensor([1.0 - 2 * side, 1, 1]).double()
        vertices[ball] = probes[side] + old_ball * (radius / EYE_RADIUS)
    return Anatomy(vertices, probes[:2], radius, probes[2:])
