"""A shirt's collar and shoulders about the neck of the sculpture, with its place on the texture's page."""

from functools import lru_cache

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from torchface.synthetic.head.identity import sculpted_vertices
from torchface.synthetic.head.skin_texture import noise
from torchface.synthetic.head.teeth_and_tongue import HeadPart
from torchface.synthetic.head.topology import topology

SHIRT_PATCH = (0.392, 0.785, 0.426, 0.985)  # place on the page that cloth is coloured from
# From inside the collar to the chest: height in front, at the side, at the back; half width, half depth, depth of the
# middle; millimetres.
_LOOPS = np.array([
    (-158, -146, -138, 55, 61, -30), (-149, -136, -129, 56.5, 63, -30), (-147, -134, -127, 58.5, 65, -30),
    (-149, -136, -129, 61, 67, -31), (-158, -144, -137, 65, 70, -32), (-160, -146, -140, 64, 71, -32),
    (-170, -154, -152, 84, 78, -35), (-184, -163, -166, 116, 87, -38), (-200, -177, -184, 150, 95, -40),
    (-222, -200, -208, 176, 100, -41), (-246, -230, -236, 188, 104, -41), (-268, -262, -258, 190, 106, -41),
])  # fmt: skip
_ROUND, _ROWS = 48, 22


@lru_cache(maxsize=1)
def shirt() -> HeadPart:
    """The cloth on the sculpture."""
    spots = np.linspace(0, len(_LOOPS) - 1, _ROWS)
    front, side, back, wide, deep, middle = PchipInterpolator(np.arange(len(_LOOPS)), _LOOPS)(spots).T[:, :, None]
    angle = (np.arange(_ROUND) + 0.5) * 2 * np.pi / _ROUND  # 0 to the person's left, a quarter forward
    across, ahead = np.cos(angle), np.sin(angle)
    y = side + np.where(ahead > 0, front - side, back - side) * np.abs(ahead) ** 1.6
    points = np.stack([wide * across, y, middle + deep * ahead], -1)
    return HeadPart.grid(torch.from_numpy(points), SHIRT_PATCH, closed=True)


def about_neck(points: Tensor, skin: Tensor) -> Tensor:
    """Points (P,3) about the sculpture's neck, about that of another head (V,3)."""
    half = topology().grid[-1]
    ids = torch.cat([half, topology().mirror[half]])
    mean, here = sculpted_vertices()[ids], skin[ids]
    low, high, own_low, own_high = mean.amin(0), mean.amax(0), here.amin(0), here.amax(0)
    scale = (own_high - own_low) / (high - low)
    scale[1] = 1
    return (own_low + own_high) / 2 + (points - (low + high) / 2) * scale


def cloth(at: Tensor) -> Tensor:
    """How light the weave is at places (M,2 or 3) of the patch, about 1."""
    return 1 + 0.06 * noise(at * torch.tensor([260.0, 260.0, 1.0]), 1.0, 71)
