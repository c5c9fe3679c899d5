"""A take through a filter that runs frame by frame."""

import torch
from torch import Tensor

from torchface.temporal import AdaptiveFilter, KalmanFilter, OneEuroFilter


def filtered(running: AdaptiveFilter | KalmanFilter | OneEuroFilter, values: Tensor) -> Tensor:
    """Each frame of values (T,...) from itself and those before it."""
    return torch.stack([running.step(frame).clone() for frame in values])
