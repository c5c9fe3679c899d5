"""Parts of a face in a picture whose colours are known."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.landmarks.images.networks.part_network import PARTS


def planted_parts(picture: Tensor, colors: Mapping[str, Tensor | Sequence[float]], near: float = 0.15) -> FaceParts:
    """What a picture (3,H,W) shows: the part whose colour each pixel has, elsewhere skin."""
    height, width = picture.shape[1:]
    number = torch.full((max(height, width),) * 2, PARTS.index("background"))
    number[:height, :width] = PARTS.index("skin")
    for name, color in colors.items():
        alike = (picture - torch.as_tensor(color)[:, None, None]).norm(dim=0) < near
        number[:height, :width][alike] = PARTS.index(name)
    shares = torch.nn.functional.one_hot(number, len(PARTS)).permute(2, 0, 1).float()
    return FaceParts(shares, torch.eye(2, 3, dtype=torch.float64))
