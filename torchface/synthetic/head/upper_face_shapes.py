"""Shapes of the upper face: lids that slide over the eyeball, eye rotation, brows, nose and cheeks."""

import math
from functools import cache

import torch
from torch import Tensor

from torchface.synthetic.head.facial_openings import lid_order
from torchface.synthetic.head.identity import Anatomy, both_sides, bump, ramp, sculpted_vertices
from torchface.synthetic.head.signed_distance import LID_THICKNESS
from torchface.synthetic.head.topology import EYE_RIM, topology

CLOSING_HEIGHT = 0.18  # where the lids meet, as a share of the way from the lower to the upper edge
GAZE = math.radians(26.0)  # rotation of an eye at weight 1

# How much of the lid edge's way each ring goes: skin from the orbit to the edge (8), then the inner lid and socket.
_FOLLOW = torch.tensor(
    [0.0, 0.02, 0.06, 0.15, 0.42, 0.72, 0.88, 0.96, 1.0, 1.0, 0.72, 0.42, 0.18, 0.05, 0.0, 0.0], dtype=torch.float64
)


def _lids(
    head: Anatomy,
    upper: Tensor | float,
    lower: Tensor | float,
    lean: float = 0.0,
    aside: tuple[float, float] = (0.0, 0.0),
) -> Tensor:
    """The left lids moved by shares of their own way to where they meet; negative opens. Displacement (V,3).

    Args:
        upper, lower: share of the way at weight 1, one number a lid or (17,) along it from the inner corner.
        lean: how far the upper skin fold follows beyond the edge's own motion, millimetres up.
        aside: how far the upper and the lower lid are drawn along the ball, millimetres outward; the corners stay.
    """
    t = topology()
    rings = t.rings["eye"]
    centre = head.eye_centres[0]
    around = head.vertices[rings] - centre
    above, below = lid_order()
    moved = around.clone()
    share = torch.zeros(2, 17, dtype=torch.float64)
    share[0], share[1] = upper, lower
    way = torch.zeros(len(rings), 32, 3, dtype=torch.float64)
    height = _closing_heights(around, above, below)[:, None]
    for ring in range(EYE_RIM, EYE_RIM + 2):
        a, b = around[ring, above], around[ring, below]
        meet = height * a + (1 - height) * b
        longest = torch.maximum(a.norm(dim=1), b.norm(dim=1))
        meet = torch.nn.functional.normalize(meet, dim=1) * longest[:, None]
        way[ring, above] = share[0][:, None] * (meet - a)
        way[ring, below[1:-1]] = (share[1][:, None] * (meet - b))[1:-1]
        moved[ring] = around[ring] + way[ring]
        radius = around[ring].norm(dim=1)
        goal = radius.clone()
        goal[above] += share[0].clamp(-1, 1).abs() * (longest - a.norm(dim=1))
        goal[below[1:-1]] += (share[1].clamp(-1, 1).abs() * (longest - b.norm(dim=1)))[1:-1]
        moved[ring] *= (goal / moved[ring].norm(dim=1))[:, None]
    travel = torch.zeros(32, dtype=torch.float64)
    travel[below] = share[1].clamp(-1, 1).abs()
    travel[above] = share[0].clamp(-1, 1).abs()
    edge_way = moved[EYE_RIM] - around[EYE_RIM]
    step = torch.arange(17)
    from_corner = torch.zeros(32, dtype=torch.float64)
    for lid in (above, below):
        from_corner[lid] = torch.minimum(step, 16 - step).double()
    for ring in (*range(1, EYE_RIM), *range(EYE_RIM + 2, len(rings) - 1)):
        # Near the corners the skin gives way sooner: it turns about the corner instead of sliding past it.
        give = (EYE_RIM - ring) if ring < EYE_RIM else 0
        near = 1 - min(0.75 + 0.06 * give, 0.92) * torch.exp(-from_corner / 1.5) if give else torch.ones(32)
        moved[ring] = around[ring] + (_FOLLOW[ring] * near)[:, None] * edge_way
        if ring >= 4:  # nearer the edge the skin slides over the ball; what lay folded in the crease comes up
            now = around[ring].norm(dim=1)
            cover = head.eye_radius + (LID_THICKNESS + 0.1 if ring < EYE_RIM else 0.0)
            goal = now + travel * 0.2 * torch.nn.functional.softplus((cover - now) / 0.2)
            moved[ring] *= (goal / moved[ring].norm(dim=1))[:, None]
    fold = torch.zeros(32, dtype=torch.float64)
    fold[above] = torch.sin(math.pi * torch.arange(17).double() / 16)
    moved[1:6, :, 1] += lean * fold * torch.tensor([0.3, 0.7, 1.0, 0.9, 0.5]).double()[:, None]
    ways, along = torch.zeros(32, dtype=torch.float64), torch.sin(math.pi * step.double() / 16)
    for lid, amount in zip((above, below), aside, strict=True):
        ways[lid] = amount * along**2
    radius = moved.norm(dim=-1, keepdim=True)
    moved[..., 0] += _FOLLOW[:, None] * ways
    moved *= radius / moved.norm(dim=-1, keepdim=True)
    delta = torch.zeros_like(head.vertices)
    delta[rings] = moved - around
    return delta


def _closing_heights(around: Tensor, above: Tensor, below: Tensor) -> Tensor:
    """Where the lids meet, as a share of the way from the lower to the upper edge, (17,).

    Beside a corner they meet on the line in which the skin outside goes on, so that nothing folds there.
    """
    step = torch.arange(17)
    height = torch.full((17,), CLOSING_HEIGHT, dtype=torch.float64)
    rim = around[EYE_RIM]
    for beside, corner in ((1, 0), (15, 16)):
        tip = rim[above[corner]]
        way = around[EYE_RIM - 1, above[corner]] - tip
        a, b = rim[above[beside]], rim[below[beside]]
        line = tip[1] + way[1] / way[0] * (0.5 * (a[0] + b[0]) - tip[0])
        wanted = ((line - b[1]) / (a[1] - b[1])).clamp(-0.1, 1.1)
        near = torch.exp(-((step - beside).abs().double() / 1.5))
        height = height + (wanted - CLOSING_HEIGHT) * near
    return height


def _rotated_eye(head: Anatomy, pitch: float, yaw: float) -> Tensor:
    """The left eyeball rotated: pitch up, yaw toward the viewer's right, radians."""
    t = topology()
    ids = torch.cat([t.eyeball.flatten(), t.caps["eyeball_front"].flatten(), t.caps["eyeball_back"].flatten()]).unique()
    c, s = math.cos(yaw), math.sin(yaw)
    about_y = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    c, s = math.cos(-pitch), math.sin(-pitch)
    about_x = torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]], dtype=torch.float64)
    delta = torch.zeros_like(head.vertices)
    offset = head.vertices[ids] - head.eye_centres[0]
    delta[ids] = offset @ (about_y @ about_x).T - offset
    return delta


@cache
def free_skin() -> Tensor:
    """1 where brow and cheek motion may go: not on lid edges, eyeballs, sockets or inside the mouth, (V,)."""
    t = topology()
    free = torch.ones(t.count, dtype=torch.float64)
    share = torch.tensor([1, 0.9, 0.6, 0.3, 0.12, 0.04, 0.0, 0.0] + [0.0] * 8, dtype=torch.float64)[:, None]
    for side in (0, 1):
        free[both_sides(t.rings["eye"])[side]] = share.expand(-1, 32)
        for part in ("eye", "eyeball_front", "eyeball_back"):
            free[both_sides(t.caps[part])[side]] = 0.0
        free[both_sides(t.eyeball)[side]] = 0.0
        free[both_sides(t.rings["mouth"])[side][9:]] = 0.0
        free[both_sides(t.caps["mouth"])[side]] = 0.0
    return free


Place = tuple[float, float, float]


@cache
def _pushed(centre: Place, width: Place, one_side: bool) -> Tensor:
    """How much of a push the skin near a point of the sculpture takes, (V,): alike in all heads."""
    p = sculpted_vertices()
    left = ramp(p[:, 0], -9, 9) if one_side else torch.ones(len(p), dtype=p.dtype)
    amount = bump(p, centre, width)
    return torch.where(amount > 0.02, amount - 0.02, 0.0) * left * free_skin()


def _push(head: Anatomy, centre: Place, width: Place, way: Place, one_side: bool = True) -> Tensor:
    """Skin near a point of the sculpture moved along ``way`` (millimetres, left side; x is mirrored)."""
    p, amount = sculpted_vertices(), _pushed(centre, width, one_side)
    direction = torch.tensor(way, dtype=p.dtype) * torch.stack(
        [torch.tanh(p[:, 0] / 5), torch.ones(len(p)), torch.ones(len(p))], dim=1
    )
    return amount[:, None] * direction * _scale(head)


def _scale(head: Anatomy) -> Tensor:
    """How large the face is against the mean: pupils to the mouth's corners, pupil to pupil."""
    t = topology()
    corner = t.rings["mouth"][9, 13]
    size = lambda v, eyes: (eyes.mean(0)[1] - v[corner, 1]) * eyes[0, 0]  # noqa: E731
    mean = size(sculpted_vertices(), torch.tensor([[31.5, 0.0, 66.5], [-31.5, 0.0, 66.5]]).double())
    return (size(head.vertices, head.eye_centres) / mean).sqrt()


def upper_face(head: Anatomy) -> dict[str, Tensor]:
    """Left and unpaired shapes of eyes, brows, nose and cheeks; displacements (V,3) by ARKit name."""
    lids = lambda *args, **more: _lids(head, *args, **more)  # noqa: E731
    push = lambda *args, **more: _push(head, *args, **more)  # noqa: E731
    open_height, along = _opening(head), torch.sin(math.pi * torch.arange(17).double() / 16)
    brow_inner, brow_mid, brow_outer = (9.0, 22.0, 89.0), (26.0, 24.0, 86.0), (46.0, 19.0, 70.0)
    under_lid, cheek, cheekbone, outer_fold = (
        (32.0, -14.0, 77.0),
        (38.0, -24.0, 68.0),
        (55.0, -30.0, 42.0),
        (46.0, 8.0, 72.0),
    )
    return {
        "eyeBlinkLeft": lids(1.0, 1.0, aside=(-1.6, -1.6)),
        "eyeWideLeft": lids(-0.33, -0.12, lean=0.8) + push((30, 20, 82), (17, 8, 20), (0, 1.2, 0)),
        "eyeSquintLeft": lids(0.04, 1.4 * along, aside=(0.0, -1.8))
        + push(under_lid, (12, 6, 18), (-2.6, 1.4, 0.5))
        + push((36, -20, 70), (12, 6, 20), (-1.0, 0.5, 0.2)),
        "eyeLookDownLeft": _rotated_eye(head, -GAZE, 0)
        + lids(0.66, -1.2 * along)
        + push(under_lid, (12, 6, 18), (0, -0.8, -0.8)),
        "eyeLookUpLeft": _rotated_eye(head, GAZE, 0) + lids(-0.42, 0.7 * along, lean=0.8),
        "eyeLookInLeft": _rotated_eye(head, 0, -1.15 * GAZE)
        + lids(0.0, 0.0, aside=(-1.8, -1.5))
        + push(under_lid, (12, 6, 18), (-1, 0, 0)),
        "eyeLookOutLeft": _rotated_eye(head, 0, 1.15 * GAZE)
        + lids(0.0, 0.0, aside=(1.8, 1.5))
        + push(under_lid, (12, 6, 18), (1, 0, 0)),
        "browDownLeft": push(brow_inner, (11, 10, 20), (-1.4, -4.6, 0.9))
        + push(brow_mid, (14, 10, 20), (-3.2, -4.6, 1.6))
        + push(brow_outer, (11, 10, 20), (-2.2, -2.4, 2.8))
        + push(outer_fold, (9, 8, 18), (-2, -3, 3))
        + push((0, 14, 93), (6, 9, 16), (0, -1, 0.6))
        + lids(0.10 * open_height, 0.0),
        "browOuterUpLeft": push(brow_outer, (13, 13, 24), (1.2, 8.2, -2.8))
        + push(brow_mid, (11, 12, 24), (1.2, 5, -0.4))
        + push(outer_fold, (9, 8, 18), (0.4, 5, -0.5)),
        "browInnerUp": push((10.0, 25.0, 89.0), (15, 14, 24), (0.6, 8.0, 0.2), one_side=False)
        + push((24.0, 24.0, 86.0), (10, 11, 24), (0.8, 2.8, -0.4), one_side=False),
        "cheekSquintLeft": push(cheek, (16, 12, 22), (-0.6, 5, 1.4))
        + push(cheekbone, (12, 14, 20), (-0.5, 3, 2.5))
        + push((44, -54, 56), (14, 13, 22), (1.0, 5, 2.2))
        + push((53, -2, 62), (9, 10, 18), (-1.5, 1.5, 3))
        + push((26, -42, 78), (10, 10, 16), (0.8, 1.4, -0.6))
        + lids(0.0, 0.8 * along),
        "noseSneerLeft": push((15, -34, 92), (8, 9, 16), (0.5, 3.0, 0.2))
        + push((20, -46, 86), (10, 9, 18), (0.4, 2.6, 0.0))
        + push((24, -38, 80), (9, 9, 16), (-1, 2.2, 1.2))
        + push((12, -22, 90), (6, 10, 14), (-0.8, 2.4, 1.4))
        + push(cheek, (14, 11, 20), (-0.8, 3.8, 1.8))
        + push((44, -54, 56), (13, 13, 22), (-0.6, 1.4, 1.4))
        + push((9, 4, 84), (8, 9, 14), (0.0, 0.8, 0.8))
        + push((0, 14, 93), (6, 9, 16), (0, -1.6, 0.4))
        + push(brow_inner, (9, 9, 20), (-0.6, -3.2, 0.0))
        + push(brow_mid, (11, 9, 20), (-0.9, -2.2, 0.4)),
    }


def _opening(head: Anatomy) -> float:
    """The lids' opening against the sculpture's."""
    rim = topology().rings["eye"][EYE_RIM]
    above, below = lid_order()
    gap = lambda v: float(v[rim[above[8]], 1] - v[rim[below[8]], 1])  # noqa: E731
    return gap(head.vertices) / gap(sculpted_vertices())
