"""The edges of lids on a head's skin without its eyeballs: where the skin, seen from the front, ends or falls away."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import look_at
from torchface.rendering.raycast import RayCaster

_SIDE = 320  # pixels of the picture
_LEAST_WIDTH, _LEAST_HEIGHT = 0.12, 0.03  # of the opening, in sides of the picture
_COARSE = 2  # pixels: what closes the opening is smooth, and costs the fourth power of its size
_AROUND, _DEEP = 61, 0.1  # of these over which skin closes the opening, and sides that the opening is deeper than that
_EDGE = 2  # pixels from the opening to the skin that is taken for the lid's edge
_SMOOTH = 5  # columns


@dataclass(frozen=True, eq=False)
class Opening:
    """The edges of lids or lips, from the viewer's left to the right."""

    # upper, lower: (n,3), each column of pixels one point
    upper: Tensor
    lower: Tensor
    share: Tensor  # how far each lies along the line between the corners, (n,) in [0,1]

    @staticmethod
    def smoothed(upper: Tensor, lower: Tensor, share: Tensor) -> "Opening":
        """Each edge the median over neighbouring columns, which spikes of lashes do not shift."""
        padded = [
            torch.cat([edge[:1].expand(_SMOOTH // 2, 3), edge, edge[-1:].expand(_SMOOTH // 2, 3)])
            for edge in (upper, lower)
        ]
        first, second = (edge.unfold(0, _SMOOTH, 1).median(-1).values for edge in padded)
        return Opening(first, second, share)

    def at(self, shares: Tensor) -> tuple[Tensor, Tensor]:
        """Points of the upper and lower edge (k,3) at shares (k,) of the way between the corners."""
        edges = []
        for edge in (self.upper, self.lower):
            columns = [np.interp(shares.numpy(), self.share.numpy(), column.numpy()) for column in edge.T]
            edges.append(torch.from_numpy(np.stack(columns, 1)))
        return edges[0], edges[1]


def eye_opening(vertices: Tensor, skin: Tensor, middle: Tensor, span: float) -> Opening | None:
    """The opening of an eye, seen from the front; none where the skin is whole there, as of closed or painted eyes.

    Vertices (V,3) are of an upright head that looks along z, skin (F,3) is without eyeballs and lashes; the picture's
    ``span`` is about twice an eye's width.
    """
    camera = look_at(middle, 0.0, 0.0, span, _SIDE, _SIDE)
    origins, directions = (rays.reshape(-1, 3) for rays in camera.rays())
    hits = RayCaster(vertices, skin).cast(origins, directions)
    behind = middle[2] - span
    points = (origins + hits.distance[:, None] * directions).reshape(_SIDE, _SIDE, 3)
    depth = points[..., 2].masked_fill((hits.triangle < 0).reshape(_SIDE, _SIDE), behind).clamp(min=behind)
    front = depth.numpy().astype(np.float32)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_AROUND, _AROUND))
    closed = cv2.morphologyEx(front[::_COARSE, ::_COARSE], cv2.MORPH_CLOSE, around)
    pit = (closed.repeat(_COARSE, 0).repeat(_COARSE, 1) - front > _DEEP * span).astype(np.uint8)
    _, labels = cv2.connectedComponents(pit, connectivity=4)
    centre = slice(_SIDE // 2 - _SIDE // 8, _SIDE // 2 + _SIDE // 8)
    counts = np.bincount(labels[centre, centre].ravel())
    counts[0] = 0
    if not counts.any():
        return None
    mask = labels == counts.argmax()
    columns = np.flatnonzero(mask.any(0))
    top, bottom = mask.argmax(0)[columns], _SIDE - 1 - mask[::-1].argmax(0)[columns]
    borders = mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()
    small = len(columns) < _LEAST_WIDTH * _SIDE or (bottom - top).max() < _LEAST_HEIGHT * _SIDE
    if borders or small:
        return None
    above, below = (np.clip(rows, 0, _SIDE - 1) for rows in (top - _EDGE, bottom + _EDGE))
    x = torch.from_numpy(columns)
    upper, lower = points[torch.from_numpy(above), x], points[torch.from_numpy(below), x]
    usable = torch.isfinite(upper).all(-1) & torch.isfinite(lower).all(-1)
    if int(usable.sum()) < _LEAST_WIDTH * _SIDE / 2:
        return None
    share = ((x - x[0]).double() / float(x[-1] - x[0]))[usable]
    return Opening.smoothed(upper[usable], lower[usable], share)
