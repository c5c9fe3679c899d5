"""Geometry of a portrait besides the bare head: hair, teeth, shoulders; and the visible jaw line."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from torchface.geometry.meshes.operators import vertex_normals
from torchface.rendering.raycast import RayCaster
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.identity import ramp, sculpted_vertices

_TEETH_DEEP = 3.5  # behind the lips, millimetres
# Millimetres: of teeth behind skin; of what one sees behind them through an open mouth; from where one looks.
_BEHIND, _THROAT, _AHEAD = 2.0, 12.0, 100.0
# The left brow's upper edge from its inner end: annotators mark it there, the head's own landmarks lie in its middle.
_BROW_EDGE = ((11.0, 20.5, 92.0), (22.0, 24.0, 90.0), (34.0, 26.0, 85.0), (44.5, 24.0, 76.0), (54.0, 17.0, 62.0))


@dataclass(frozen=True)
class Hairdo:
    """Hair of one person."""

    thickness: float  # over the scalp, millimetres; 0 is shaved
    hairline: float  # how far it has moved up, millimetres; negative falls over the forehead
    curtain: float  # how far it hangs below the eyes, millimetres; 0 is short hair
    opening: float  # half the angle that a curtain leaves free in front, degrees


@dataclass(frozen=True, eq=False)
class Portrait:
    """A head with what belongs to it as one mesh."""

    vertices: Tensor  # (V,3), millimetres, the head's own first
    faces: Tensor  # (F,3), the head's own first
    part: Tensor  # of each face, (F,): 0 head, 1 curtain of hair, 2 teeth, 3 clothes


def portrait(rest: Tensor, moved: Tensor, faces: Tensor, hairdo: Hairdo, generator: torch.Generator) -> Portrait:
    """Puts hair, teeth and shoulders on a head, (V,3) at rest and with its expression."""
    rest, moved = rest.double(), moved.double()
    share = hair_share(hairdo.hairline)
    uneven = lumps(rest, generator)
    lift = hairdo.thickness * share * (1.0 + 0.4 * uneven).clamp(min=0.1)
    head = moved + lift[:, None] * vertex_normals(moved, faces)
    pieces = [(head, faces, 0)]
    if hairdo.curtain > 0:
        pieces.append((*curtain(rest, hairdo, generator), 1))
    pieces += [(*row, 2) for row in teeth(rest, moved, faces)]
    pieces.append((*shoulders(rest), 3))
    sizes = [len(piece[0]) for piece in pieces]
    first = [sum(sizes[:i]) for i in range(len(sizes))]
    return Portrait(
        torch.cat([vertices for vertices, _, _ in pieces]),
        torch.cat([piece[1] + start for piece, start in zip(pieces, first, strict=True)]),
        torch.cat([torch.full((len(piece[1]),), piece[2]) for piece in pieces]),
    )


def widened(vertices: Tensor, share: float) -> Tensor:
    """A head (V,3) whose cheeks, jaw and temples stand further out by a share; eyes, nose and mouth hardly move."""
    wide = vertices.clone()
    wide[..., 0] = vertices[..., 0] * (1 + share * ramp(vertices[..., 0].abs(), 15.0, 62.0))
    return wide


def hair_share(hairline: float) -> Tensor:
    """0 on the face, 1 on the scalp, (V,), for a hairline moved up by so many millimetres."""
    regions = head_annotations().regions
    return hair_share_at(sculpted_vertices(), regions["ear_left"] | regions["ear_right"], hairline)


def hair_share_at(p: Tensor, ear: Tensor, hairline: float) -> Tensor:
    """See ``hair_share``; at points (N,3) of the mean head, of which some are an ear's, (N,) bool."""
    x, y, z = p[:, 0].abs(), p[:, 1], p[:, 2]
    line = np.interp(
        z.numpy(), [-200, -70, -30, -14, 8, 20, 34, 48, 62, 90], [-85, -80, -50, -18, -2, 10, 36, 52, 57, 63]
    )
    front = ramp(z, 30, 70)  # at the sides the hair keeps to the ears, however high or low it is in front
    edge = torch.from_numpy(line) + 0.03 * (x - 40).clamp(min=0) + hairline * front
    return ramp(y - edge, -5.0, 7.0) * ~ear


def _marks() -> Tensor:
    marks = head_annotations().landmarks
    assert marks is not None
    return marks


def lumps(points: Tensor, generator: torch.Generator, waves: int = 12) -> Tensor:
    """A smooth random field of about unit size, (N,), of 20 to 70 mm."""
    heading = torch.nn.functional.normalize(torch.randn(waves, 3, generator=generator).double(), dim=-1)
    draw = torch.rand(waves, 2, generator=generator).double()
    phase = points @ (heading * (2 * math.pi / (20 + 50 * draw[:, :1]))).T + 2 * math.pi * draw[:, 1]
    return phase.sin().sum(1) * math.sqrt(2 / waves)


def _grid_faces(rows: int, columns: int) -> Tensor:
    ids = torch.arange(rows * columns).view(rows, columns)
    a, b, c, d = ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]
    return torch.cat([torch.stack([a, b, c], -1).view(-1, 3), torch.stack([a, c, d], -1).view(-1, 3)])


def curtain(rest: Tensor, hairdo: Hairdo, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Hair that hangs from the temples round the back of the head."""
    rows, columns = 24, 60
    opening = math.radians(hairdo.opening)
    angle = torch.linspace(opening, 2 * math.pi - opening, columns).double()  # 0 is in front
    down = torch.linspace(0, 1, rows).double()[:, None]
    wide = float(rest[:, 0].max()) - 4 + hairdo.thickness
    far = float(-rest[:, 2].min()) + hairdo.thickness
    front = 62.0
    radius_z = (far + front) / 2 + 6
    y = 70.0 - down * (70.0 + hairdo.curtain)
    bulge = 0.72 + 0.33 * torch.sin(math.pi * (0.18 + 0.5 * down)) + 0.05 * down
    x = wide * bulge * angle.sin()
    z = (front - far) / 2 + radius_z * bulge * angle.cos() - 6
    points = torch.stack([x, y.expand_as(x), z], -1).view(-1, 3)
    outward = points * points.new_tensor([1.0, 0.0, 1.0])
    points = points + 5.0 * lumps(points, generator)[:, None] * torch.nn.functional.normalize(outward, dim=-1)
    return points, _grid_faces(rows, columns)


def teeth(rest: Tensor, moved: Tensor, faces: Tensor) -> list[tuple[Tensor, Tensor]]:
    """The upper row, which stays with the skull, and the lower, which goes with the chin."""
    marks = _marks()
    rest_points, moved_points = rest[marks], moved[marks]
    middle = rest_points[[62, 66]].mean(0)
    half = 0.42 * float((rest_points[54] - rest_points[48]).norm())
    x = torch.linspace(-half, half, 17).double()
    arch = middle[2] - _TEETH_DEEP - 18.0 * (x / half) ** 2
    rows = []
    for top, bottom, shift in ((3.0, -6.5, torch.zeros(3).double()), (-4.0, -12.0, moved_points[8] - rest_points[8])):
        y = middle[1] + torch.linspace(top, bottom, 4).double()[:, None]
        set_back = 0.0 if top > 0 else -1.5
        points = torch.stack([x.expand(4, 17), y.expand(4, 17), (arch + set_back).expand(4, 17)], -1).view(-1, 3)
        rows.append((_behind(points + shift, moved, faces), _grid_faces(4, 17)))
    return rows


def _behind(points: Tensor, head: Tensor, faces: Tensor) -> Tensor:
    """Points (P,3) no nearer than 2 mm behind the skin of a head (V,3) before them, whose chin may lie far back."""
    ahead = torch.tensor([0.0, 0.0, _AHEAD], dtype=points.dtype)
    way = points.new_tensor([0.0, 0.0, -1.0]).expand(len(points), 3)
    skin = points[:, 2] + _AHEAD - RayCaster(head, faces).cast(points + ahead, way).distance
    seen = skin < points[:, 2] - _THROAT  # through an open mouth
    z = torch.where(seen, points[:, 2], torch.minimum(points[:, 2], skin - _BEHIND))
    return torch.cat([points[:, :2], z[:, None]], dim=1)


def shoulders(rest: Tensor, marks: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """A bust's upper side below the neck of a head (V,3) with 68 landmark vertices, the performer's if absent."""
    rows, columns = 14, 40
    turn = torch.linspace(0, 2 * math.pi, columns).double()
    up = torch.linspace(0.05, math.pi / 2, rows).double()[:, None]
    chin = float(rest[(_marks() if marks is None else marks)[8], 1])
    height = (chin - 175 + 125 * up.cos()).expand(rows, columns)
    points = torch.stack([215 * up.sin() * turn.sin(), height, -25 + 110 * up.sin() * turn.cos()], -1)
    return points.view(-1, 3), _grid_faces(rows, columns)


@lru_cache(maxsize=1)
def _performer_contours() -> tuple[Tensor, ...]:
    regions = head_annotations().regions
    hidden = ("mouth_interior", "nostrils", "eye_sockets", "eyeball_left", "eyeball_right", "ear_left", "ear_right")
    return contour_lines(sculpted_vertices(), _marks(), ~torch.stack([regions[name] for name in hidden]).any(0))


def contour_lines(p: Tensor, marks: Tensor, skin: Tensor) -> tuple[Tensor, ...]:
    """For each of the jaw's 17 landmarks the vertices from it toward the face's middle, the landmark first.

    They lie in the plane through the landmark that holds the viewing axis and the line to the face's middle.
    """
    lines = []
    for row in range(17):
        end = p[marks[row]]
        middle = torch.tensor([0.0, min(float(end[1]) + 25.0, -40.0), 0.0]).double()
        ray = end[:2] - middle[:2]
        length = ray.norm()
        along = (p[:, :2] - middle[:2]) @ (ray / length)
        aside = (p[:, 0] - middle[0]) * ray[1] / length - (p[:, 1] - middle[1]) * ray[0] / length
        near = skin & (aside.abs() < 3.5) & (along > 0.45 * length) & (p[:, 2] > end[2]) & (along < 1.05 * length)
        lines.append(torch.cat([marks[row : row + 1], near.nonzero()[:, 0]]))
    return tuple(lines)


@lru_cache(maxsize=1)
def _brow_edge() -> tuple[Tensor, Tensor]:
    """Vertices (10,3) and weights (10,3) that give the brows' upper edges, in the order of landmarks 17 to 26."""
    left = torch.tensor(_BROW_EDGE).double()
    spots = torch.cat([left.flip(0) * left.new_tensor([-1.0, 1.0, 1.0]), left])
    distance, rows = torch.cdist(spots, sculpted_vertices()).topk(3, dim=1, largest=False)
    weights = 1 / distance.clamp(min=0.1)
    return rows, weights / weights.sum(1, keepdim=True)


def annotated_landmarks(pixels: Tensor) -> Tensor:
    """The 68 landmarks (68,2) of a head's vertices (V,2), pixels, as an annotator sees them.

    Brows are marked along their upper edge, and where cheeks hide the jaw's line, the cheeks' outline is.
    """
    marks = _marks()
    seen = pixels[marks].clone()
    rows, weights = _brow_edge()
    seen[17:27] = (pixels[rows] * weights[..., None].to(pixels)).sum(1)
    return with_visible_jaw(seen, pixels, _performer_contours())


def with_visible_jaw(seen: Tensor, pixels: Tensor, lines: tuple[Tensor, ...]) -> Tensor:
    """Landmarks (68,2) with the jaw's where the face, of vertices (V,2), ends: where cheeks hide its line, the
    cheeks' outline is; by ``contour_lines``."""
    seen, middle = seen.clone(), seen[27:36].mean(0)
    for row, line in enumerate(lines):  # lines differ in length
        way = torch.nn.functional.normalize(seen[row] - middle, dim=0)
        seen[row] = pixels[line[((pixels[line] - middle) @ way).argmax()]]
    return seen
