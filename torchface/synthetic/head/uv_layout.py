"""Texture coordinates: the head unrolled from a seam at the back, crown and eyeballs as islands above it."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from torchface.synthetic.head.sculpture import sculpture
from torchface.synthetic.head.signed_distance import EYE_CENTRE, EYE_RADIUS
from torchface.synthetic.head.topology import COLUMNS, ROWS, topology

SKIN_TOP = 0.78  # below it lies the unrolled skin, above it the islands

CROWN_ISLAND = (0.5, 0.89, 0.095)
EYE_ISLANDS = ((0.88, 0.89, 0.095), (0.12, 0.89, 0.095))
"""Centre and radius of the islands: crown, left and right eyeball."""


@dataclass(frozen=True, eq=False)
class Unwrapping:
    """Coordinates (U,2) and the rows of them at each quad's corners, (P,4)."""

    uvs: Tensor
    quads: Tensor


@lru_cache(maxsize=1)
def unwrapping() -> Unwrapping:
    """The same for every head."""
    t, half = topology(), sculpture()
    row, azimuth = half.plane[:, 0], half.plane[:, 1]
    # The face takes more than its share of the width.
    across = azimuth / torch.pi
    across = 0.485 * (across + 0.22 * torch.sin(2 * torch.pi * across) / 2)
    up = SKIN_TOP - 0.012 - (SKIN_TOP - 0.03) * _row_height(row)
    left = torch.stack([0.5 + across, up], dim=1)
    right = torch.stack([0.5 - across, up], dim=1)
    skin = torch.zeros(t.count, 2, dtype=torch.float64)
    skin[t.other_half] = right
    skin[: t.half_count] = left
    # Layers: the skin's own rows, then the right copy of the back seam, then the islands.
    count = t.count
    seam = t.grid[:, COLUMNS][t.grid[:, COLUMNS] >= 0]
    seam_row = torch.arange(count)
    seam_row[seam] = count + torch.arange(len(seam))
    seam_uv = torch.stack([1 - skin[seam, 0], skin[seam, 1]], dim=1)
    crown = t.crown.flatten()
    both_crown = torch.cat([crown, t.mirror[crown]]).unique()
    crown_row = torch.arange(count)
    crown_row[both_crown] = count + len(seam) + torch.arange(len(both_crown))
    whole = torch.zeros(count, 3, dtype=torch.float64)
    whole[t.other_half] = half.vertices * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    whole[: t.half_count] = half.vertices
    flat = whole[both_crown][:, [0, 2]]
    flat = torch.stack([flat[:, 0], -(flat[:, 1] + 14)], dim=1) / 80.0
    cx, cy, radius = CROWN_ISLAND
    crown_uv = torch.tensor([cx, cy]).double() + radius * flat
    uv_quads = t.quads.clone()
    half_count = len(t.half_quads)
    on_left = torch.arange(len(t.quads)) < half_count
    uv_quads[~on_left] = seam_row[uv_quads[~on_left]]
    in_crown = torch.zeros(count, dtype=torch.bool)
    in_crown[both_crown] = True
    crown_quads = in_crown[t.quads].all(1)
    uv_quads[crown_quads] = crown_row[t.quads[crown_quads]]
    balls = torch.cat(
        [t.eyeball.flatten(), t.caps["eyeball_front"].flatten(), t.caps["eyeball_back"].flatten()]
    ).unique()
    for side, (cx, cy, radius) in enumerate(EYE_ISLANDS):
        ids = balls if side == 0 else t.mirror[balls]
        skin[ids] = torch.tensor([cx, cy]).double() + radius * _eye_disc(whole[ids], side)
    # The grid at the back of each eyeball cannot lie in the disc: it is a small island of its own.
    rows = [skin, seam_uv, crown_uv]
    for side, (cx, cy) in enumerate(((0.76, 0.96), (0.24, 0.96))):
        cap = t.caps["eyeball_back"].flatten() if side == 0 else t.mirror[t.caps["eyeball_back"].flatten()]
        cap_row = torch.arange(count)
        cap_row[cap] = sum(map(len, rows)) + torch.arange(len(cap))
        inside = torch.zeros(count, dtype=torch.bool)
        inside[cap] = True
        quads = inside[t.quads].all(1)
        uv_quads[quads] = cap_row[t.quads[quads]]
        flat = (whole[cap][:, :2] - whole[cap][:, :2].mean(0)) * torch.tensor([-1.0, 1.0]).double()
        rows.append(torch.tensor([cx, cy]).double() + 0.005 * flat)
    return Unwrapping(torch.cat(rows).float(), uv_quads)


def _row_height(row: Tensor) -> Tensor:
    """Rows 0..ROWS as heights 0..1 down the page, the face's rows given room."""
    import numpy as np
    from scipy.interpolate import PchipInterpolator

    knots = np.array([0, 4, 8, 14, 22, 28, 34, ROWS])
    height = np.array([0, 0.13, 0.26, 0.43, 0.56, 0.745, 0.87, 1.0])
    return torch.from_numpy(PchipInterpolator(knots, height)(row.clamp(0, ROWS).numpy()))


def _eye_disc(points: Tensor, side: int) -> Tensor:
    """The eyeball seen from in front, opened out until its back pole is the disc's border."""
    centre = torch.tensor(EYE_CENTRE).double() * torch.tensor([1.0 - 2 * side, 1, 1]).double()
    way = torch.nn.functional.normalize(points - centre, dim=1)
    polar = torch.acos(way[:, 2].clamp(-1, 1))
    flat = torch.nn.functional.normalize(way[:, :2], dim=1, eps=1e-9)
    assert EYE_RADIUS > 0
    return flat * (polar / torch.pi)[:, None]
