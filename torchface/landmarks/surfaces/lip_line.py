"""The line between lips that are two pieces: where, seen from the front, the skin goes from one to the other."""

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.geometry.meshes.operators import triangle_normals
from torchface.landmarks.surfaces.eye_openings import Opening
from torchface.rendering.raycast import RayCaster

_STEP, _WIDTH, _HEIGHT = 0.4, 100.0, 84.0  # millimetres: between rays, and of the picture
_DEEP, _OPEN = 4.0, 24.0  # millimetres: a step in depth that is no line between lips, and how far they may be open
_REACH, _ASTRAY = 16.0, 0.3  # millimetres from the found lips at most, and what a column costs there; off a line, 1
_LEAN = 0.1  # what a step of the line up or down costs
_GAP, _LEAST = 8.0, 0.7  # millimetres without a line at most; of the found lips' width at least
_SHARP = 0.9  # how much more upward the skin looks below a crease than above it, of its normal


def lip_line(vertices: Tensor, skin: Tensor, lips: Tensor) -> Opening | None:
    """The edges of a mouth's lips; none where they are one piece, or are not seen from the front.

    Rays from the front that are neighbours but meet triangles without a common vertex have a fold of the skin between
    them. The line is the path from left to right through the most of them, near the lips that were found in pictures.

    Args:
        vertices: of a head, (V,3), upright, looking along z, millimetres; those that a file has split at seams are one.
        skin: its triangles without those of teeth and tongue, (F,3).
        lips: points of the lips, (n,3), a centimetre off or less.
    """
    middle, width = lips.mean(0), float(lips[:, 0].amax() - lips[:, 0].amin())
    points, triangle = _picture(vertices, skin, middle)
    depth = points[..., 2].numpy().astype(np.float32)
    open_mouth = cv2.morphologyEx(depth, cv2.MORPH_CLOSE, np.ones((int(_OPEN / _STEP), 1), np.uint8)) - depth > _DEEP
    fold = _folds(vertices, skin, triangle) & (np.abs(np.diff(depth, axis=0)) < _DEEP) | open_mouth[:-1]
    away = (points[:-1, 0, 1] - middle[1]).abs().numpy()
    row = _path(fold, away / _REACH)
    run = _run(fold[row, np.arange(len(row))])
    if not len(run):
        return None
    # At the corners of coarse lips triangles share a vertex.
    up = triangle_normals(vertices, skin)[triangle.clamp(min=0), 1].numpy()
    crease = fold | (np.diff(up, axis=0) > _SHARP)
    left, right = (
        float(points[0, _corner(crease, row[end], end, way), 0]) for end, way in ((run[0], -1), (run[-1], 1))
    )
    if right - left < _LEAST * width:
        return None
    upper, lower = row[run], row[run] + 1
    for rows, way in ((upper, -1), (lower, 1)):
        while (inside := open_mouth[rows, run] & (rows > 0) & (rows < len(depth) - 1)).any():
            rows[inside] += way
    at = torch.from_numpy(run)
    share = (points[0, at, 0] - left) / (right - left)
    return Opening.smoothed(points[torch.from_numpy(upper), at], points[torch.from_numpy(lower), at], share)


def _picture(vertices: Tensor, skin: Tensor, middle: Tensor) -> tuple[Tensor, Tensor]:
    """Where parallel rays from the front meet the skin, (H,W,3), and in which triangle, (H,W); -1 for none."""
    across, down = (torch.arange(-size / 2, size / 2, _STEP, dtype=torch.float64) for size in (_WIDTH, _HEIGHT))
    y, x = torch.meshgrid(middle[1] - down, middle[0] + across, indexing="ij")
    near, far = float(middle[2]) + _WIDTH / 2, _WIDTH
    origins = torch.stack([x, y, torch.full_like(x, near)], -1)
    ahead = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand(x.numel(), 3)
    hits = RayCaster(vertices, skin).cast(origins.reshape(-1, 3), ahead)
    z = near - hits.distance.reshape(x.shape).clamp(max=far)
    return torch.stack([x, y, z], -1), hits.triangle.reshape(x.shape)


def _folds(vertices: Tensor, skin: Tensor, triangle: Tensor) -> np.ndarray:
    """Between which rays and those below them the skin is folded, (H-1,W)."""
    corner = skin[triangle.clamp(min=0)]
    apart = (triangle[:-1] >= 0) & (triangle[1:] >= 0) & ~_shared(corner[:-1], corner[1:]).any(-1)
    row, column = apart.nonzero().T
    ends = torch.cat([skin[:, [0, 1]], skin[:, [1, 2]], skin[:, [2, 0]]])
    short = ends[(vertices[ends[:, 0]] - vertices[ends[:, 1]]).norm(dim=-1) < 2 * _STEP]
    known = torch.cat([short, short.flip(1)]) @ torch.tensor([len(vertices), 1])
    above, below = corner[:-1][row, column], corner[1:][row, column]
    pairs = (above[:, :, None] * len(vertices) + below[:, None]).flatten(1)
    apart[row, column] = ~torch.isin(pairs, known).any(1)  # rays pass over triangles smaller than the way between them
    return apart.numpy()


def _shared(one: Tensor, other: Tensor) -> Tensor:
    """Which corners of triangles (...,3) others have too."""
    return (one[..., :, None] == other[..., None, :]).any(-1)


def _path(fold: np.ndarray, away: np.ndarray) -> np.ndarray:
    """The row of the cheapest way from left to right in each column, (W,); rows are so far (H,) from it at most 1."""
    total = (~fold + np.where(away < 1, _ASTRAY * away**2, np.inf)[:, None]).T
    best = np.zeros(total.shape, np.int64)
    for column in range(1, len(total)):  # each follows from the one before
        before = np.pad(total[column - 1], 1, constant_values=np.inf)
        ways = np.stack([before[:-2] + _LEAN, before[1:-1], before[2:] + _LEAN])
        best[column] = ways.argmin(0) - 1
        total[column] += ways.min(0)
    row = np.full(len(total), total[-1].argmin())
    for column in range(len(total) - 1, 0, -1):
        row[column - 1] = row[column] + best[column, row[column]]
    return row


def _run(on: np.ndarray) -> np.ndarray:
    """The columns of the longest piece of a line, and of pieces beside it that are longer than the gaps before them."""
    columns = np.flatnonzero(on)
    pieces = np.split(columns, np.flatnonzero(np.diff(columns) > 1) + 1)
    first = last = max(range(len(pieces)), key=lambda piece: len(pieces[piece]))

    def goes_on(piece: int, gap: int) -> bool:
        return gap <= min(_GAP / _STEP, len(pieces[piece]))

    while first > 0 and goes_on(first - 1, pieces[first][0] - pieces[first - 1][-1] - 1):
        first -= 1
    while last < len(pieces) - 1 and goes_on(last + 1, pieces[last + 1][0] - pieces[last][-1] - 1):
        last += 1
    return np.concatenate(pieces[first : last + 1])


def _corner(crease: np.ndarray, row: int, column: int, way: int) -> int:
    """The column of the mouth's corner: as far beyond a line's end as a crease goes on."""
    while 0 <= column + way < crease.shape[1]:
        near = slice(max(row - 1, 0), row + 2)
        on = np.flatnonzero(crease[near, column + way])
        if not len(on):
            break
        row, column = near.start + int(on[np.abs(on + near.start - row).argmin()]), column + way
    return column
