"""Shapes of the lower face: jaw, lips and mouth, in millimetres that follow the head's own jaw and mouth."""

import math

import torch
from torch import Tensor

from torchface.synthetic.head.handle_weights import LIP_HANDLES, HandleWeights, handle_weights
from torchface.synthetic.head.identity import Anatomy, bump, mirrored, ramp, sculpted_vertices
from torchface.synthetic.head.topology import MOUTH_CONTACT, topology

JAW_ANGLE = math.radians(19.0)
_HANDLE = torch.arange(LIP_HANDLES)
_SIDE = torch.where(_HANDLE > 26, 52 - _HANDLE, _HANDLE)  # 0 upper midline, 13 corner, 26 lower midline
_LEFT = torch.where(_HANDLE > 26, -1.0, 1.0).double()


# A lip rolled in over the teeth: for each ring the motion up and forward, millimetres.
_ROLL_LOWER = {
    4: (0.6, -0.6), 5: (3.2, -2.2), 6: (3.6, -4.2), 7: (2.4, -5.6),
    8: (0.6, -5.0), 9: (0.0, -3.8), 10: (-0.6, -3.2), 11: (0.0, -2.4),
}  # fmt: skip
_ROLL_UPPER = {
    4: (-0.6, -0.6), 5: (-3.0, -2.0), 6: (-3.2, -3.8), 7: (-2.0, -4.8),
    8: (-0.6, -4.2), 9: (0.0, -3.4), 10: (0.5, -3.0), 11: (0.0, -2.4),
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
        # The dental arch: how far the line of contact falls back toward the corners.
        self.arch = (line[0, 2] - line[13, 2]) / self.half_width**2.2
        # 0 on the midline to ±1 at the corners.
        across = torch.zeros(LIP_HANDLES, dtype=torch.float64)
        across[:27] = line[:, 0] / self.half_width
        across[27:] = -line[1:26, 0].flip(0) / self.half_width
        self.across = across
        self.is_lower = (_SIDE > 13).double()
        self.is_upper = (_SIDE < 13).double()
        self.left = ramp(across, -0.35, 0.35)
        self.corner = torch.exp(-(((_SIDE - 13) / 3.6) ** 2))

    def slide(self, x: Tensor | float, y: Tensor | float, z: Tensor | float = 0.0) -> Tensor:
        """Handle motion (52,3): what goes sideways also follows the arch of the teeth."""
        x, y, z = (torch.as_tensor(v, dtype=torch.float64).expand(LIP_HANDLES) for v in (x, y, z))
        now = self.across.abs() * self.half_width
        out = (now + x * self.across.sign()).clamp(min=0)
        return torch.stack([x, y, z - self.arch * (out**2.2 - now**2.2)], dim=1)

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

    def push(self, centre: tuple[float, float, float], width: tuple[float, float, float], way: Tensor) -> Tensor:
        """Left skin near a point of the sculpture moved along ``way`` (3,); the mouth's inside and the lips stay."""
        outside = (self.weights.lip_ring < MOUTH_CONTACT - 3) & ~_inside()
        amount = (bump(self.mean, centre, width) - 0.02).clamp(min=0) * ramp(self.mean[:, 0], -6, 10) * outside
        return amount[:, None] * way * self.size


def _inside() -> Tensor:
    t = topology()
    mask = torch.zeros(t.count, dtype=torch.bool)
    mask[t.caps["mouth"]] = True
    mask[t.mirror[t.caps["mouth"]]] = True
    return mask


def lower_face(head: Anatomy) -> dict[str, Tensor]:
    """Left and unpaired shapes of jaw and mouth; displacements (V,3) by ARKit name."""
    m = Mouth(head)
    w, size = m.half_width, m.size
    a, aa = m.across, m.across.abs()
    mid = (1 - aa**2).clamp(min=0)
    left_corner = m.corner * (_LEFT > 0)
    opened = m.jaw(JAW_ANGLE, (0, -1.0, -1.5)) + m.skin_motion(m.slide(-0.05 * a * w * m.corner, 0.0))
    vec = lambda *xyz: torch.tensor(xyz, dtype=torch.float64)  # noqa: E731
    chin = m.push((0, -96, 88), (16, 12, 16), vec(0, 3.4, 0.8))
    return {
        "jawOpen": opened,
        "jawForward": m.jaw(translation=(0, -0.6, 6.5)),
        "jawLeft": m.jaw(translation=(2.5, -0.4, 0.0), yaw=math.radians(4.5)),
        "mouthClose": _close(m, opened),
        "mouthFunnel": _funnel(m, mid),
        "mouthPucker": _pucker(m, mid),
        "mouthLeft": m.skin_motion(m.slide(0.24 * w * (0.65 + 0.35 * a), 0.8 * left_corner, 0.0)),
        "mouthSmileLeft": _smile(m, left_corner)
        + m.push((36, -34, 68), (13, 13, 20), vec(0.6, 3.2, 2.4))
        + m.push((37, -62, 60), (8, 14, 16), vec(1.8, 1.0, -1.6)),
        "mouthFrownLeft": _side_motion(m, 0.05 * w, -7.0 * size, -0.4, 4.2)
        + m.push((24, -84, 78), (9, 8, 14), vec(0.6, -1.6, 1.0)),
        "mouthDimpleLeft": _side_motion(m, 0.16 * w, 1.2 * size, -3.0, 2.8),
        "mouthStretchLeft": _side_motion(m, 0.24 * w, -3.6 * size, -0.6, 5.0),
        "mouthRollLower": m.profile({}, _ROLL_LOWER, mid)
        + m.skin_motion(m.slide(0.0, 0.8 * m.is_lower * mid, 0.0)),
        "mouthRollUpper": m.profile(_ROLL_UPPER, {}, mid)
        + m.skin_motion(m.slide(0.0, -0.5 * m.is_upper * mid, 0.0)),
        "mouthShrugLower": m.skin_motion(
            m.slide(0.0, (3.6 * m.is_lower + 2.4 * m.is_upper) * mid * size, 1.6 * m.is_lower * mid)
        ) + chin + mirrored(chin),
        "mouthShrugUpper": m.skin_motion(
            m.slide(0.0, (3.2 * m.is_upper + 0.9 * m.is_lower) * mid * size, 1.4 * m.is_upper * mid)
        ),
        "mouthPressLeft": _press(m),
        "mouthLowerDownLeft": _lift(m, m.is_lower * mid, 0.6, -6.2, -0.4),
        "mouthUpperUpLeft": _lift(m, m.is_upper * mid, 0.4, 5.6, -0.2)
        + m.push((22, -42, 84), (9, 10, 16), vec(0.2, 2.2, 0.8)),
    }  # fmt: skip


def _gaussian(across: Tensor, centre: float, width: float) -> Tensor:
    return torch.exp(-(((across - centre) / width) ** 2))


def _lift(m: Mouth, lip: Tensor, out: float, up: float, forward: float) -> Tensor:
    """The left half of a lip drawn up or down; ``lip`` (52,) says which handles, the rest is in millimetres."""
    side = lip * m.left
    return m.skin_motion(
        m.slide(out * m.size * side, up * m.size * side * _gaussian(m.across, 0.35, 0.75), forward * side)
    )


def _smile(m: Mouth, corner: Tensor) -> Tensor:
    reach = torch.exp(-(((_SIDE - 13) / 5.2) ** 2)) * (_LEFT > 0)
    pull = 0.8 * reach + 0.2 * corner + 0.12 * (1 - m.across.abs()) * m.left
    out = 0.27 * m.half_width * pull
    up = 8.2 * m.size * (0.75 * reach**1.5 + 0.25 * corner) + 0.6 * m.size * (m.is_upper * m.left) * (1 - reach)
    return m.skin_motion(m.slide(out, up, -0.8 * pull))


def _side_motion(m: Mouth, out: Tensor, up: Tensor | float, back: float, breadth: float) -> Tensor:
    reach = torch.exp(-(((_SIDE - 13) / breadth) ** 2)) * m.left
    return m.skin_motion(m.slide(out * reach, up * reach, back * reach))


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


def _funnel(m: Mouth, mid: Tensor) -> Tensor:
    narrow = -0.26 * m.half_width * m.across
    part = (5.0 * m.is_upper - 6.5 * m.is_lower) * m.size * mid
    lips = m.skin_motion(m.slide(narrow, part, (3.0 + 2.0 * mid) * m.size))
    rolled = {5: (0.6, 0.6), 6: (1.2, 1.4), 7: (1.2, 2.0), 8: (0.8, 1.6), 9: (0.2, 0.8)}
    return lips + m.profile(rolled, {k: (-up, forward) for k, (up, forward) in rolled.items()}, mid)


def _pucker(m: Mouth, mid: Tensor) -> Tensor:
    narrow = -0.42 * m.half_width * m.across
    lips = m.skin_motion(m.slide(narrow, 0.0, (2.2 + 2.8 * mid) * m.size))
    rolled = {5: (0.2, 0.4), 6: (0.8, 1.0), 7: (0.8, 1.4), 8: (0.3, 0.9), 9: (0.0, 0.2)}
    return lips + m.profile(rolled, {k: (-up, forward) for k, (up, forward) in rolled.items()}, mid)


def _press(m: Mouth) -> Tensor:
    """The left half of the lower lip pressed up against the upper one; the skin below follows and bulges."""
    share = m.left * (1 - m.across.abs() ** 4) * _gaussian(m.across, 0.45, 0.7)
    upper = {4: (-0.2, 0.0), 5: (-1.0, -0.1), 6: (-0.8, -0.4), 7: (-0.5, -0.6), 8: (-0.2, -0.5), 9: (0.0, -0.3)}
    lower = {4: (1.4, 0.9), 5: (2.6, 1.1), 6: (2.0, 0.5), 7: (1.1, -0.2), 8: (0.4, -0.5), 9: (0.0, -0.3)}
    chin = m.push((14, -86, 86), (12, 9, 14), torch.tensor((0.0, 1.6, 0.7), dtype=torch.float64))
    up = (0.9 * m.is_lower + 0.5 * m.is_upper) * share * m.size
    return m.profile(upper, lower, share) + chin + m.skin_motion(m.slide(0.0, up, 0.6 * m.is_lower * share))
