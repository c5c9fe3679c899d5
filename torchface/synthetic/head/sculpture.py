"""The sculpture's vertices: the grid cast onto the form, then lids, lips, nostrils, ears and eyeballs laid in."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.interpolate import CubicSpline, PchipInterpolator
from torch import Tensor

from torchface.synthetic.head.facial_openings import (
    LID_SHARES,
    LIP_SHARES,
    MOUTH_HALF_WIDTH,
    STOMION_HEIGHT,
    ear_rings,
    eye_rings,
    eyeball_points,
    mouth_rings,
    nostril_rings,
)
from torchface.synthetic.head.signed_distance import cast, project
from torchface.synthetic.head.topology import (
    CAP_SIDE,
    COLUMNS,
    EAR,
    EYE,
    EYE_RIM,
    MOUTH,
    MOUTH_BORDER,
    MOUTH_CONTACT,
    NOSTRIL,
    ROWS,
    Topology,
    topology,
)

GUIDE_WIDTH = 74.0

# Row, then the guide curve that the row follows round the head: height in front, at the side, at the back; depth in
# front, at the side, at the back; tilt of the outward ray in front, at the side, at the back (degrees).
_ROWS = np.array([
    #  row  front  side   back  front side back  tilt
    (0, 97.0, 97.0, 97.0, 60, -12, -80, 54, 54, 54),
    (2, 80.0, 80.0, 80.0, 74, -12, -92, 38, 38, 38),
    (4, 60.0, 60.0, 60.0, 88, -12, -95, 18, 18, 18),
    (6, 34.0, 34.0, 34.0, 92, -10, -96, 4, 4, 4),
    (7, 25.5, 25.5, 25.5, 92, -9, -96, 0, 0, 0),
    (8, 18.5, 18.5, 18.0, 92, -8, -95, 0, 0, 0),
    (14, -16.0, -17.0, -19.0, 90, -6, -86, 0, 0, -8),
    (18, -31.0, -33.0, -42.0, 92, -6, -76, 0, 0, -8),
    (22, -47.5, -49.5, -62.0, 92, -6, -70, 0, 0, -5),
    (28, -86.0, -71.0, -94.0, 90, -4, -70, 0, 0, 0),
    (31, -102.0, -80.0, -110.0, 88, -4, -72, -10, -5, 0),
    (33, -112.0, -88.0, -120.0, 80, -6, -74, -50, -30, 0),
    (34, -115.0, -95.0, -126.0, 71, -10, -76, -75, -40, 0),
    (36, -119.0, -111.0, -138.0, 50, -18, -80, -70, -15, 0),
    (38, -128.0, -126.0, -146.0, 35, -22, -84, -25, 0, 0),
    (43, -164.0, -164.0, -170.0, 30, -28, -90, 0, 0, 0),
])  # fmt: skip

# Frontal distance from the midline (mm) of a few columns on a few rows.
_COLUMN_KNOTS = np.array([0, 3, 6, 10, 16])
_COLUMN_ROWS = np.array([0, 5, 8, 14, 18, 21, 25, 29, 33, 37, 43])
_COLUMN_AT = np.array([
    (0, 6.0, 13.0, 26.0, 46.0),
    (0, 5.5, 12.0, 26.0, 53.0),
    (0, 4.6, 10.5, 28.0, 55.5),
    (0, 5.0, 11.5, 29.0, 57.0),
    (0, 6.6, 16.0, 30.0, 57.0),
    (0, 7.8, 19.0, 32.5, 57.0),
    (0, 8.6, 19.5, 34.0, 57.0),
    (0, 8.6, 18.5, 31.0, 56.0),
    (0, 7.5, 16.0, 28.0, 54.0),
    (0, 7.5, 16.0, 28.0, 50.0),
    (0, 7.5, 16.0, 28.0, 50.0),
])  # fmt: skip
_EAR_SPAN = (79.5, 104.0)  # azimuth of the ear's block, degrees

# Where rows pass over the nose's lower half: row, then a point near the form for each of these columns.
_NOSE_COLUMNS = np.array([0, 1, 3, 5, 6])
_NOSE_ROWS = {
    17: ((0, -29.5, 110.0), (2.8, -29.5, 109.5), (8.6, -29.5, 104.0), (14.5, -30.5, 92.0), (17.5, -31.0, 86.0)),
    18: ((0, -34.5, 112.5), (2.9, -34.5, 112.0), (9.2, -35.0, 106.0), (15.8, -34.5, 95.0), (18.2, -34.5, 88.0)),
    19: ((0, -40.0, 110.0), (2.8, -40.3, 109.5), (8.8, -40.8, 104.0), (16.0, -39.5, 95.0), (18.4, -39.0, 88.0)),
    20: ((0, -43.6, 104.5), (2.7, -43.8, 104.0), (8.0, -43.5, 98.0), (15.0, -42.8, 92.0), (18.0, -42.5, 87.5)),
    21: ((0, -46.2, 94.2), (2.9, -46.0, 93.6), (7.4, -44.8, 93.0), (13.4, -44.6, 89.5), (18.0, -45.2, 87.0)),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Sculpture:
    """The half head: vertices (H,3) float64 and where each lies in the unrolled plane, (H,2)."""

    vertices: Tensor
    plane: Tensor


def _bend(front: Tensor, side: Tensor, back: Tensor, cosine: Tensor) -> Tensor:
    return side + cosine * (front - back) / 2 + cosine**2 * ((front + back) / 2 - side)


def _guide(row: Tensor, azimuth: Tensor) -> tuple[Tensor, Tensor]:
    """Points near the head and outward rays for grid coordinates: row (N,) and azimuth (N,) radians."""
    f = torch.from_numpy(PchipInterpolator(_ROWS[:, 0], _ROWS[:, 1:])(row.numpy()))
    cosine, sine = azimuth.cos(), azimuth.sin()
    y = _bend(f[:, 0], f[:, 1], f[:, 2], cosine)
    z = _bend(f[:, 3], f[:, 4], f[:, 5], cosine)
    tilt = _bend(f[:, 6], f[:, 7], f[:, 8], cosine)
    elevation = ((97.0 - y) / 17).clamp(0, 3)  # the crown draws together
    width = GUIDE_WIDTH * (1 - 0.16 * (1 - elevation / 3) ** 2)
    x = width * sine
    tilt = torch.deg2rad(tilt)
    azimuth = torch.atan2(sine / width, cosine / 88.0)
    ray = torch.stack([azimuth.sin() * tilt.cos(), tilt.sin(), azimuth.cos() * tilt.cos()], dim=1)
    return torch.stack([x, y, z], dim=1), ray


def _azimuth_of(x: Tensor) -> Tensor:
    return torch.asin((x / GUIDE_WIDTH).clamp(-0.999, 0.999))


def _grid_plane() -> Tensor:
    """Row and azimuth (ROWS+1, COLUMNS+1, 2) of every grid point, those inside blocks as well."""
    rows = np.arange(ROWS + 1)
    at_knots = PchipInterpolator(_COLUMN_ROWS, _COLUMN_AT, axis=0)(rows)
    front = CubicSpline(_COLUMN_KNOTS, at_knots, axis=1)(np.arange(17))
    azimuth = np.zeros((ROWS + 1, COLUMNS + 1))
    azimuth[:, :17] = np.arcsin(front / GUIDE_WIDTH)
    inner = azimuth[:, 16]
    first, last = np.deg2rad(_EAR_SPAN)
    columns = np.arange(16, COLUMNS + 1)
    knots = np.array([16, EAR.left, EAR.right, COLUMNS])
    for i in rows:  # a spline a row: each starts where its front columns end
        azimuth[i, 16:] = PchipInterpolator(knots, [inner[i], first, last, np.pi])(columns)
    plane = np.stack([np.broadcast_to(rows[:, None], azimuth.shape), azimuth], axis=-1)
    return torch.from_numpy(plane.astype(float))


def row_of_height(height: Tensor) -> Tensor:
    """The fractional row whose front guide runs at a height (mm)."""
    order = np.argsort(_ROWS[:, 1])
    return torch.from_numpy(PchipInterpolator(_ROWS[order, 1], _ROWS[order, 0])(height.numpy()))


def onto_form(points: Tensor) -> Tensor:
    """Where a viewer in front, a little to the side for what lies aside, sees the form near points (N,3)."""
    azimuth = 0.6 * _azimuth_of(points[:, 0])
    ray = torch.stack([azimuth.sin(), torch.zeros_like(azimuth), azimuth.cos()], dim=1)
    return cast(points + 12 * ray, -ray, 30)


def coons(border: Tensor, height: int, width: int) -> Tensor:
    """A grid (height+1, width+1, D) filled from its border, which is clockwise from the upper left corner, (L,D)."""
    top, right = border[: width + 1], border[width : width + height + 1]
    bottom = border[width + height : 2 * width + height + 1].flip(0)
    left = torch.cat([border[2 * width + height :], border[:1]]).flip(0)
    u = torch.linspace(0, 1, width + 1, dtype=border.dtype)[None, :, None]
    v = torch.linspace(0, 1, height + 1, dtype=border.dtype)[:, None, None]
    ruled = (1 - v) * top + v * bottom + (1 - u) * left[:, None] + u * right[:, None]
    corner = (1 - u) * (1 - v) * top[0] + u * (1 - v) * top[-1] + (1 - u) * v * bottom[0] + u * v * bottom[-1]
    return ruled - corner


@lru_cache(maxsize=1)
def sculpture() -> Sculpture:
    """The half head, computed once."""
    t = topology()
    vertices = torch.zeros(t.half_count, 3, dtype=torch.float64)
    plane = torch.zeros(t.half_count, 2, dtype=torch.float64)
    on_grid = t.grid >= 0
    full_plane = _grid_plane()
    plane[t.grid[on_grid]] = full_plane[on_grid]
    start, ray = _guide(plane[t.grid[on_grid], 0], plane[t.grid[on_grid], 1])
    vertices[t.grid[on_grid]] = cast(start + 45 * ray, -ray)
    _crown(t, vertices, plane)
    _nose(t, vertices)
    _relax(t, vertices)
    _lay_rings(t, vertices, plane)
    vertices[t.midline, 0] = 0.0
    return Sculpture(vertices, plane)


def _nose(t: Topology, vertices: Tensor) -> None:
    """Rows over and under the nose, where rays from the front would miss, laid by their table."""
    for row, points in _NOSE_ROWS.items():
        spots = torch.from_numpy(PchipInterpolator(_NOSE_COLUMNS, np.array(points), axis=0)(np.arange(7)))
        ids = t.grid[row, :7]
        here = ids >= 0
        vertices[ids[here]] = project(spots[here], 5)


def _crown(t: Topology, vertices: Tensor, plane: Tensor) -> None:
    """The crown cast from above; its place in the plane is a disc above row 0."""
    rim = vertices[t.grid[0]]
    border = torch.zeros(2 * (CAP_SIDE + COLUMNS - 2 * CAP_SIDE), 2, dtype=torch.float64)
    width = COLUMNS - 2 * CAP_SIDE
    disc = rim[:, [0, 2]]
    line = torch.linspace(0, 1, width + 1, dtype=torch.float64)[:, None]
    top = disc[:1] * (1 - line) + disc[-1:] * line
    right = disc[COLUMNS - CAP_SIDE :].flip(0)
    bottom = disc[CAP_SIDE : COLUMNS - CAP_SIDE + 1].flip(0)
    left = disc[: CAP_SIDE + 1].flip(0)
    border = torch.cat([top[:-1], right[:-1], bottom[:-1], left[:-1]])
    filled = coons(border, CAP_SIDE, width)
    inner = torch.ones_like(t.crown, dtype=torch.bool)
    inner[-1], inner[:, 0], inner[:, -1] = False, False, False
    spots = filled[inner]
    centre = torch.tensor([0.0, 20.0, -14.0]).double()
    target = torch.cat([spots[:, :1], torch.full((len(spots), 1), 97.0).double(), spots[:, 1:]], dim=1)
    ray = torch.nn.functional.normalize(target - centre, dim=1)
    vertices[t.crown[inner]] = cast(target + 45 * ray, -ray)
    plane[t.crown[inner]] = -1.0


def _neighbours(quads: Tensor, count: int) -> Tensor:
    """The row-stochastic average over edge neighbours, sparse (count,count)."""
    pairs = torch.cat([torch.stack([quads[:, i], quads[:, (i + 1) % 4]], 1) for i in range(4)])
    pairs = torch.cat([pairs, pairs.flip(1)]).unique(dim=0)
    degree = torch.bincount(pairs[:, 0], minlength=count).clamp(min=1).double()
    return torch.sparse_coo_tensor(pairs.T, 1 / degree[pairs[:, 0]], (count, count), check_invariants=False).coalesce()


def _relax(t: Topology, vertices: Tensor) -> None:
    """Evens the grid out along the form; ring systems come later, so only quads between grid and crown count."""
    present = torch.zeros(t.half_count, dtype=torch.bool)
    present[t.grid[t.grid >= 0]] = True
    present[t.crown] = True
    quads = t.half_quads[present[t.half_quads].all(1)]
    average = _neighbours(quads, t.half_count)
    fixed = ~present
    for edge in (t.grid[-1], *(t.rings[name][0] for name in t.rings)):
        fixed[edge] = True
    for _ in range(6):
        mean = average @ vertices
        step = torch.where(fixed[:, None], vertices, 0.5 * vertices + 0.5 * mean)
        step[~fixed] = project(step[~fixed], 1)
        step[t.midline, 0] = 0.0
        vertices.copy_(step)


def _lay_rings(t: Topology, vertices: Tensor, plane: Tensor) -> None:
    for name, block, shape in (
        ("eye", EYE, eye_rings),
        ("mouth", MOUTH, mouth_rings),
        ("nostril", NOSTRIL, nostril_rings),
        ("ear", EAR, ear_rings),
    ):
        rings = t.rings[name]
        placed = shape(vertices[rings[0]], onto_form)
        vertices[rings[1:]] = placed[1:]
        centre = plane[rings[0]].amin(0) + (plane[rings[0]].amax(0) - plane[rings[0]].amin(0)) / 2
        skin = 0
        if name in ("eye", "mouth"):  # what is skin keeps its frontal place
            skin = MOUTH_CONTACT if name == "mouth" else EYE_RIM
            spots = placed[1 : skin + 1].clone()
            if name == "mouth":
                _part_lips(spots)
            plane[rings[1 : skin + 1], 0] = row_of_height(spots[..., 1].clamp(-112, 97))
            plane[rings[1 : skin + 1], 1] = _azimuth_of(spots[..., 0])
            shares = torch.tensor(LID_SHARES if name == "eye" else LIP_SHARES).double()[1:, None, None]
            edge = plane[rings[len(shares)]]
            plane[rings[1 : len(shares) + 1]] = plane[rings[0]] * (1 - shares) + edge * shares
            centre = plane[rings[skin]].mean(0) if name == "eye" else centre
        if name == "mouth":
            centre = torch.tensor([float(plane[rings[skin, [0, -1]], 0].mean()), 0.0]).double()
        share = torch.linspace(1, 0.08, len(rings) - skin, dtype=torch.float64)[:, None, None]
        plane[rings[skin + 1 :]] = (centre + (plane[rings[skin]] - centre) * share)[1:]
        _fill_cap(t.caps[name], vertices, plane, block.height, block.width, half=name == "mouth")
    loops, front, back = t.eyeball, t.caps["eyeball_front"], t.caps["eyeball_back"]
    vertices[loops], vertices[front], vertices[back] = eyeball_points(loops, front, back)


def _part_lips(spots: Tensor) -> None:
    """Opens the lips in the plane, so that there is room on the page for the inside of the mouth; rings from 1."""
    across = (spots[MOUTH_CONTACT - 1, :, 0] / MOUTH_HALF_WIDTH).clamp(max=1)
    sign = torch.where(torch.arange(27) < 13, 1.0, -1.0).double()
    line = STOMION_HEIGHT - 0.8 * across**3 + sign * 2.2 * (1 - across**2)
    border = spots[MOUTH_BORDER - 1, :, 1].clone()
    for ring in range(MOUTH_BORDER, MOUTH_CONTACT):
        share = (ring - MOUTH_BORDER + 1) / (MOUTH_CONTACT - MOUTH_BORDER)
        spots[ring, :, 1] = border + share * (line - border)
        spots[ring, :, 0] = spots[MOUTH_BORDER - 1, :, 0] * (1 - share) + spots[MOUTH_CONTACT - 1, :, 0] * share


def _fill_cap(cap: Tensor, vertices: Tensor, plane: Tensor, height: int, width: int, half: bool) -> None:
    """A flat-ish fill of a closing grid; a half one is mirrored first, so that it meets its twin evenly."""
    for values in (vertices, plane):
        if half:
            side = values[torch.cat([cap[0], cap[1:-1, -1], cap[-1].flip(0)])]
            flip = torch.ones(values.shape[1], dtype=values.dtype)
            flip[0 if values is vertices else 1] = -1
            loop = torch.cat([side, (side * flip).flip(0)[1:-1]])
            loop = loop.roll(width, 0)
            values[cap] = coons(loop, height, 2 * width)[:, width:]
        else:
            loop = values[torch.cat([cap[0], cap[1:-1, -1], cap[-1].flip(0), cap[1:-1, 0].flip(0)])]
            values[cap] = coons(loop, height, width)
