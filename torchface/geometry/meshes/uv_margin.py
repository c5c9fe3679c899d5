"""Values at texels laid out as an image, with a margin around the charts so that no background shows at their seams."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.geometry.meshes.uv_raster import TexelMap

_RINGS = 4


def laid_out(values: Tensor, texels: TexelMap, rings: int = _RINGS) -> Tensor:
    """A texture (C,H,W) float32 of values (M,C) at its texels.

    Around the charts stands the mean of the neighbours that have a colour, ring by ring; beyond that the mean of all.

    Args:
        values: of each texel of the map.
        texels: where they lie.
        rings: how many texels wide the margin is.
    """
    channels = values.shape[1]
    image = torch.zeros(channels, texels.height * texels.width, dtype=torch.float32)
    image[:, texels.texels] = values.T.float()
    image = image.reshape(1, channels, texels.height, texels.width)
    filled = texels.mask()[None, None].float()
    background = values.float().mean(0) if len(values) else torch.zeros(channels, dtype=torch.float32)
    for _ in range(rings):  # a ring of texels at a time
        count = torch.nn.functional.avg_pool2d(filled, 3, 1, 1, count_include_pad=True)
        mean = torch.nn.functional.avg_pool2d(image * filled, 3, 1, 1) / count.clamp(min=1e-6)
        image = torch.where(filled > 0, image, torch.where(count > 0, mean, image))
        filled = (count > 1e-6).float()
    return torch.where(filled > 0, image, background.reshape(1, channels, 1, 1))[0].contiguous()
