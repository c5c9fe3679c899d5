"""Shapes of the lower face: jaw, lips and mouth, in millimetres that follow the head's own jaw and mouth."""

import math
from functools import cache

import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from torchface.synthetic.head.handle_weights import LIP_HANDLES, HandleWeights, handle_weights
from torchface.synthetic.head.identity import Anatomy, bump, mirrored, ramp, sculpted_vertices
from torchface.synthetic.head.topology import MOUTH_CONTACT, topology
from torchface.synthetic.head.upper_face_shapes import Place, free_skin

JAW_ANGLE = math.radians(19.0)
_HANDLE = torch.arange(LIP_HANDLES)
_SIDE = torch.where(_HANDLE > 26, 52 - _HANDLE, _HANDLE)  # 0 upper midline, 13 corner, 26 lower midline
_LEFT = torch.where(_HANDLE > 26, -1.0, 1.0).double()


# How far lips go, millimetres (sideways, up, forward) at seven places of the left half: upper lip in the middle, a
# quarter and most of the way to the corner; the corner; the lower lip back to the middle. How far each goes is what
# rigs of ARKit's shapes have in common, measured on two of them.
Lips = tuple[tuple[float, float, float], ...]
_PLACES = (0, 6, 10, 13, 16, 20, 26)
_STILL: Lips = ((0, 0, 0),) * 7
_LEFT_LIPS: dict[str, Lips] = {
    "mouthSmileLeft": ((0, 0.9, -0.5), (4.2, 3.8, -2.4), (7, 8, -6.4), (6.8, 10, -7.8),
                       (5.5, 8.5, -5.4), (3.2, 4.6, -1.0), (0, 0.9, 0.9)),
    "mouthFrownLeft": ((0, -0.7, -0.4), (1, -2.4, -1.8), (1.5, -4, -2.3), (1.4, -4.8, -2),
                       (1.2, -3.8, -1.2), (0.6, -1.2, -0.3), (0, 0, 0)),
    "mouthDimpleLeft": ((0, 0.1, 0), (1.7, -0.2, -1.2), (2.8, 1.1, -4.4), (2.4, 3, -5.8),
                        (3, 4.2, -4.6), (2, 2.4, -0.9), (0, 0.4, 0.4)),
    "mouthStretchLeft": ((0.3, -0.3, -0.4), (2.2, -1.2, -1.8), (4, -2.2, -5), (5.4, -2.6, -6.8),
                         (4.9, -2.9, -5.2), (3.3, -1, -1.6), (0.4, 0, 0.2)),
    "mouthUpperUpLeft": ((0.1, 3.8, -0.4), (2, 7, -1.3), (1.7, 5.9, -0.7), (0.2, 3.5, 0), (0, 1, 0.2), (0, 0.3, 0),
                         (0, 0.1, 0)),
    "mouthLowerDownLeft": ((0, 0, 0), (0, 0, 0), (0, -0.3, -0.1), (0, -1, -0.3),
                           (0.6, -3, -1.1), (0.8, -5.2, -1.8), (0, -2, -0.8)),
    "noseSneerLeft": ((0, 1.2, 0), (0.4, 3, 0.2), (0.2, 3.2, 0.4), (-0.3, 2.2, 0.4), (0, 1, 0.2), (0, 0.3, 0),
                      (0, 0, 0)),
    "mouthPressLeft": ((0, 0, 0.2), (0.2, 0.6, 0), (0.6, 1.8, 0.2), (0.8, 2.8, 0.8), (0.8, 4.2, 2), (0.4, 4.4, 2),
                       (0, 2, 1)),
}  # fmt: skip
_WHOLE_LIPS: dict[str, Lips] = {
    "mouthFunnel": ((0, 4.8, 6), (-1.5, 2.1, 6.7), (-3.4, -0.2, 8.4), (-4.5, 0, 8.3),
                    (-3.4, -2.3, 8.6), (-1.6, -5.6, 7), (0, -8, 4.8)),
    "mouthPucker": ((0, 1.6, 6.6), (-2.1, 1.1, 7), (-4.1, 0.4, 8.3), (-4.7, 0, 8.1), (-4.4, -0.4, 9), (-2.6, -1.2, 7),
                    (0, -1.8, 6)),
    "mouthRollLower": (*_STILL[:4], (0, 0.6, 0), (0, 1, 0), (0, 1, 0)),
    "mouthRollUpper": ((0, -0.5, 0), (0, -0.5, 0), (0, -0.3, 0), *_STILL[:4]),
    "mouthShrugLower": ((0, 0.8, 0.3), (0, 0.6, 0.2), (0.1, 0.4, 0.4), (0.3, 1, 1), (0.4, 3.2, 3), (0, 5.2, 4.2),
                        (0, 6.2, 4.6)),
    "mouthShrugUpper": ((0, 4.6, 0.8), (0, 3.5, 0.4), (0.1, 1.7, 0.2), (0, 0.5, 0), (0, 0.2, 0), (0, 0, 0), (0, 0, 0)),
    "cheekPuff": ((0, -1.1, 6.6), (-2.3, -0.7, 7.2), (-2.8, 0, 9.8), (-2.3, 0.2, 11), (-3, 0, 10.2),
                  (-2.4, -0.5, 7.8), (0, -0.9, 6.8)),
}  # fmt: skip
_MOUTH_LEFT: tuple[Lips, Lips] = (
    ((11.5, 0.6, -2.2), (8.5, 2.8, -4.8), (6.8, 5.3, -5.3), (5.8, 7, -4.4), (7, 4.8, -4.6), (9.5, 2.4, -4.6),
     (12, 0.5, -3.2)),
    ((11.5, 0.6, -2.2), (12.5, -0.8, 2.2), (11.2, -0.6, 4.4), (10.5, -0.4, 6.3), (11.7, -0.4, 4),
     (13.2, -0.6, 1.6), (12, 0.5, -3.2)),
)  # fmt: skip

# A lip rolled in over the teeth: for each ring the motion up and forward, millimetres.
_ROLL_LOWER = {
    3: (2.2, 0.9), 4: (4.4, 0.5), 5: (6.8, -0.9), 6: (6.8, -3.8), 7: (5.6, -6.8),
    8: (2.4, -6.6), 9: (0.4, -5.0), 10: (-0.6, -4.0), 11: (0.0, -3.0),
}  # fmt: skip
_ROLL_UPPER = {
    2: (-1.6, -0.4), 3: (-3.4, -1.2), 4: (-4.6, -2.6), 5: (-5.8, -4.4), 6: (-5.4, -6.0), 7: (-4.2, -7.4),
    8: (-1.6, -6.6), 9: (-0.3, -5.0), 10: (0.4, -4.0), 11: (0.0, -3.0),
}  # fmt: skip

_FUNNELLED = (
    {5: (0.2, -0.4), 6: (0.8, 0.6), 7: (0.8, 1.2), 8: (0.6, 1.2), 9: (0.2, 0.8)},
    {5: (0.2, -0.4), 6: (-0.8, 1.0), 7: (-1.2, 2.0), 8: (-0.8, 1.6), 9: (-0.2, 0.8)},
)
_PUCKERED = (
    {5: (0.0, 0.4), 6: (-0.2, 1.0), 7: (-0.8, 1.6), 8: (-1.4, 1.0), 9: (-1.6, 0.3), 10: (-1.6, 0.0), 11: (-1.6, 0.0)},
    {5: (0.0, 0.0), 6: (0.2, 1.2), 7: (0.8, 2.4), 8: (1.5, 1.6), 9: (1.8, 0.3), 10: (1.8, 0.0), 11: (1.8, 0.0)},
)
_PRESSED = (
    {5: (-0.8, 0.0), 6: (-0.7, -0.4), 7: (-0.5, -0.6), 8: (-0.2, -0.5), 9: (0.0, -0.3)},
    {5: (1.0, 0.4), 6: (0.4, 0.0), 7: (-0.6, -0.8), 8: (-1.2, -1.4), 9: (-1.6, -1.2)},
)
_OPENED: Lips = ((0, 0, 0), (0, -1.6, -1), (-0.6, -2, -1.8), (-1.2, 0, -0.4), (-0.6, 0, 0), (0, 0, 0), (0, 0, 0))
_BEYOND = 3.0  # handles from the midline to where the other half hardly follows

# What skin does beyond following the lips: about a point of the sculpture, how far that reaches, along which way.
Push = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
_ALA, _UNDER_ALA, _PHILTRUM = ((15, -38, 93), (7, 7, 14)), ((14, -50, 89), (9, 7, 14)), ((0, -52, 95), (10, 6, 14))
# The fold from the ala of the nose to the corner of the mouth.
_FOLD_HIGH, _FOLD_LOW = ((24, -38, 80), (9, 9, 16)), ((31, -52, 74), (10, 10, 18))
_CHEEK, _LOW_CHEEK = ((38, -24, 68), (14, 11, 20)), ((44, -54, 56), (13, 13, 22))
_CHEEKBONE, _JAW = ((55, -30, 42), (12, 14, 20)), ((42, -90, 42), (14, 14, 22))
_BESIDE, _UNDER_CORNER = ((40, -68, 60), (11, 12, 20)), ((27, -80, 72), (10, 10, 18))
_CHIN, _CHIN_SIDE, _HOLLOW = ((0, -97, 88), (13, 9, 16)), ((16, -88, 82), (9, 9, 16)), ((0, -83, 85), (12, 6, 16))
_SKIN: dict[str, tuple[Push, ...]] = {
    "mouthSmileLeft": ((*_CHEEK, (1.5, 2.5, 2)), (*_LOW_CHEEK, (6, 3, 7.5)), (*_CHEEKBONE, (1.5, 2.5, 1.5)),
                       (*_UNDER_CORNER, (0, 5, 1.5)), (*_JAW, (0, 0.5, 2.5)), (*_UNDER_ALA, (2, 1, -1.5)),
                       (*_HOLLOW, (0, -1, 4))),
    "mouthFrownLeft": ((*_UNDER_ALA, (1.2, -2, -1.5)), (*_UNDER_CORNER, (0.5, -1, 3)), (*_CHIN_SIDE, (0, 1.5, 2.5)),
                       (*_BESIDE, (1, -1, 1))),
    "mouthDimpleLeft": ((*_FOLD_LOW, (0, 0, 6)), (*_LOW_CHEEK, (3, 1.5, 4.5)), (*_UNDER_CORNER, (0, 6, 2.5)),
                        (*_CHIN_SIDE, (1.5, 3.5, 2))),
    "mouthStretchLeft": ((*_FOLD_LOW, (-1, 0, 2.5)), (*_BESIDE, (2.5, 0, -1.5)), (*_UNDER_CORNER, (3, 0, -1.5)),
                         (*_JAW, (2.5, -1, -2))),
    "mouthUpperUpLeft": ((*_ALA, (0.5, 1.5, 0)), (*_UNDER_ALA, (1, 3.5, -2)), (*_FOLD_HIGH, (1.5, 3.5, 1.5)),
                         (*_FOLD_LOW, (0.5, 4, 0)), (*_CHEEK, (0, 2, 1)), (*_LOW_CHEEK, (0, 1.5, 2))),
    "mouthLowerDownLeft": ((*_UNDER_CORNER, (2, 2, -1)), (*_CHIN, (0, -2.5, -2))),
    "mouthPressLeft": ((*_UNDER_CORNER, (1, 6, 3)), (*_CHIN_SIDE, (1.5, 6, 3)), (*_CHIN, (0, 6, 3)),
                       (*_LOW_CHEEK, (2, 3, 1.5)), (*_FOLD_LOW, (2, 1.5, 2.5))),
    "mouthFunnel": ((*_UNDER_ALA, (-1.5, 0, 3)), (*_FOLD_HIGH, (-0.5, 0, 2.5)), (*_LOW_CHEEK, (-1, 3, 2)),
                    (*_UNDER_CORNER, (0.5, 7, 3)), (*_JAW, (0, 2, 4)), (*_HOLLOW, (0, 3, -5))),
    "mouthPucker": ((*_UNDER_ALA, (-1.5, 0, 2.5)), (*_FOLD_HIGH, (-1, 0.5, 2)), (*_UNDER_CORNER, (0, 3, 0)),
                    (*_HOLLOW, (0, 2, -4))),
    "mouthRollLower": ((*_CHIN_SIDE, (-3, 6, 7)), (*_CHIN, (0, 3.5, 2)), (*_HOLLOW, (0, 6, 4))),
    "mouthRollUpper": ((*_UNDER_ALA, (0, -4.5, -0.5)), (*_PHILTRUM, (0, -4.5, -1))),
    "mouthShrugLower": ((*_UNDER_CORNER, (-1.5, 2.5, 1)), (*_CHIN_SIDE, (-3, 5, 0)), (*_CHIN, (0, 6, 1.2)),
                        (*_HOLLOW, (0, 3, 0))),
    "mouthLeft": ((*_ALA, (2.5, 1.5, -1.5)), (*_FOLD_LOW, (0, 3, 3.5)), (*_LOW_CHEEK, (3, 3, 4.5)),
                  (*_PHILTRUM, (8, 2, -1)), (*_UNDER_CORNER, (0, 2.5, -2))),
    "cheekPuff": ((*_UNDER_ALA, (-1, 0, 4.5)), (*_FOLD_HIGH, (0, 1, 2)), (*_FOLD_LOW, (2.5, 4, 5.5)),
                  (*_CHEEK, (0, 2, 0.5)), (*_LOW_CHEEK, (4.5, 2.5, 4.5)), (*_BESIDE, (4, 0.5, 4)),
                  (*_UNDER_CORNER, (2, 0, 4)), (*_JAW, (0, 1.5, 2.5)), (*_PHILTRUM, (0, 0.5, 3)),
                  (*_HOLLOW, (0, 0, -3))),
}  # fmt: skip


class Mouth:
    """The measurements of one head's mouth, from which its shapes are made."""

    def __init__(self, head: Anatomy) -> None:
        self.head = head
        self.weights: HandleWeights = handle_weights()
        self.mean = sculpted_vertices()
        rings = topology().rings["mouth"]
        line, mean_line = head.vertices[rings[MOUTH_CONTACT]], self.mean[rings[MOUTH_CONTACT]]
        self.half_width = line[13, 0]
        self.size = self.half_width / mean_line[13, 0]
        jaw = lambda v, hinge: (v[rings[MOUTH_CONTACT, 26]] - hinge).norm()  # noqa: E731
        mean_hinge = torch.tensor([0.0, -14.0, 8.0], dtype=torch.float64)
        self.reach = jaw(head.vertices, head.hinges.mean(0)) / jaw(self.mean, mean_hinge)
        # 0 on the midline to ±1 at the corners.
        across = torch.zeros(LIP_HANDLES, dtype=torch.float64)
        across[:27] = line[:, 0] / self.half_width
        across[27:] = -line[1:26, 0].flip(0) / self.half_width
        self.across = across
        self.is_lower = (_SIDE > 13).double()
        self.is_upper = (_SIDE < 13).double()
        self.left = ramp(across, -0.35, 0.35)

    def lips(self, left: Lips, right: Lips | None = None) -> Tensor:
        """Skin that follows lips, (V,3): displacements at the places of the left half, and the right half's.

        What only the left half does ends soon beyond the midline.
        """
        sides = _between(left)
        if right is None:
            off = torch.minimum(_SIDE, 26 - _SIDE).double()
            middle = torch.where(_SIDE[:, None] < 13, sides[0], sides[26])
            other = middle * torch.exp(-((off / _BEYOND) ** 2))[:, None]
        else:
            other = _between(right)[_SIDE]
        return self.skin_motion(torch.where(_LEFT[:, None] > 0, sides[_SIDE], other) * self.size)

    def skin_motion(self, handles: Tensor) -> Tensor:
        """Displacement (V,3) of the skin that follows the handles (52,3)."""
        return self.weights.lips @ handles

    def profile(
        self, upper: dict[int, tuple[float, float]], lower: dict[int, tuple[float, float]], share: Tensor
    ) -> Tensor:
        """Rolled lips: for rings the motion (up, forward) in mm, times ``share`` (52,) round the mouth."""
        delta = torch.zeros_like(self.head.vertices)
        ring, position = self.weights.lip_ring, self.weights.lip_position
        for side, rows in ((self.is_upper, upper), (self.is_lower, lower)):
            for number, (up, forward) in rows.items():
                ids = (ring == number).nonzero()[:, 0]
                amount = (side * share)[position[ids]]
                delta[ids, 1] += up * amount
                delta[ids, 2] += forward * amount
        return delta * self.size

    def jaw(
        self, opening: float = 0.0, translation: tuple[float, float, float] = (0.0, 0.0, 0.0), yaw: float = 0.0
    ) -> Tensor:
        """The jaw opened about its own joints (radians), rotated aside (yaw, radians) and translated (mm)."""
        v, hinge = self.head.vertices, self.head.hinges.mean(0)
        c, s = math.cos(opening), math.sin(opening)
        about_x = torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]], dtype=torch.float64)
        c, s = math.cos(yaw), math.sin(yaw)
        about_y = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
        offset = v - hinge
        moved = offset @ (about_y @ about_x).T - offset + torch.tensor(translation, dtype=torch.float64) * self.reach
        return self.weights.jaw[:, None] * moved

    def push(self, centre: Place, width: Place, way: Tensor) -> Tensor:
        """Left skin near a point of the sculpture moved along ``way`` (3,), as far as it does not follow the lips."""
        return _pushed(centre, width)[:, None] * way * self.size


@cache
def _pushed(centre: Place, width: Place) -> Tensor:
    """How much of a push each vertex takes, (V,): alike in all heads."""
    mean = sculpted_vertices()
    free = (1 - handle_weights().lips.sum(1)).clamp(0, 1) * free_skin()
    return (bump(mean, centre, width) - 0.02).clamp(min=0) * ramp(mean[:, 0], -6, 10) * free


def _between(places: Lips) -> Tensor:
    """Displacements of the handles of one half, (27,3)."""
    return torch.from_numpy(PchipInterpolator(_PLACES, torch.tensor(places).double().numpy())(range(27)))


def lower_face(head: Anatomy) -> dict[str, Tensor]:
    """Left and unpaired shapes of jaw and mouth; displacements (V,3) by ARKit name."""
    m = Mouth(head)
    mid = (1 - m.across**2).clamp(min=0)
    mirror = lambda lips: tuple((-x, y, z) for x, y, z in lips)  # noqa: E731
    opened = m.jaw(JAW_ANGLE, (0, -1.0, -1.5)) + m.lips(_OPENED, mirror(_OPENED))
    made = {name: m.lips(lips) for name, lips in _LEFT_LIPS.items()}
    made |= {name: m.lips(lips, mirror(lips)) for name, lips in _WHOLE_LIPS.items()}
    made |= {
        "jawOpen": opened,
        "jawForward": m.jaw(translation=(0, -0.6, 7.2)),
        "jawLeft": m.jaw(translation=(2.5, 0.0, 0.0), yaw=math.radians(4.5)),
        "mouthClose": _close(m, opened),
        "mouthLeft": m.lips(*_MOUTH_LEFT),
    }
    made["mouthFunnel"] += m.profile(*_FUNNELLED, mid)
    made["mouthPucker"] += m.profile(*_PUCKERED, mid)
    made["mouthRollLower"] += m.profile({}, _ROLL_LOWER, mid)
    made["mouthRollUpper"] += m.profile(_ROLL_UPPER, {}, mid)
    made["mouthPressLeft"] += m.profile(*_PRESSED, m.left * mid)
    for name, pushes in _SKIN.items():
        for centre, width, way in pushes:
            moved = m.push(centre, width, torch.tensor(way, dtype=torch.float64))
            made[name] = made[name] + (moved + mirrored(moved) if name in _WHOLE_LIPS else moved)
    return made


def _close(m: Mouth, opened: Tensor) -> Tensor:
    """Lips brought together while the jaw is open: the upper goes part of the way down, the lower comes the rest up."""
    t = topology()
    rings = t.rings["mouth"]
    line = torch.cat([rings[MOUTH_CONTACT], t.mirror[rings[MOUTH_CONTACT]][1:26].flip(0)])
    motion = opened[line]
    twin = torch.where(_HANDLE <= 26, 26 - _HANDLE, 78 - _HANDLE) % LIP_HANDLES
    # The lower lip's share of where they meet: most is the upper's, at the corners both move alike.
    share = (0.28 + 0.22 * torch.exp(-(((_SIDE - 13) / 3.0) ** 2)))[:, None]
    upper, lower = torch.where(_SIDE < 13, _HANDLE, twin), torch.where(_SIDE < 13, twin, _HANDLE)
    meet = (1 - share) * motion[upper] + share * motion[lower]
    return m.skin_motion(meet - motion)
