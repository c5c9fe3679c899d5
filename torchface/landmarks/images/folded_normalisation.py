"""Batch normalisations of a trained network as part of its convolutions."""

import copy
from typing import TypeVar

from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

Network = TypeVar("Network", bound=nn.Module)


def without_normalisation(network: Network) -> Network:
    """A copy that computes the same with batch normalisations folded into the convolutions before them."""
    fused = copy.deepcopy(network).eval()
    for part in fused.modules():
        if isinstance(part, nn.Sequential):
            for place in range(len(part) - 1):
                first, second = part[place], part[place + 1]
                if isinstance(first, nn.Conv2d) and isinstance(second, nn.BatchNorm2d):
                    part[place], part[place + 1] = fuse_conv_bn_eval(first, second), nn.Identity()
    return fused
