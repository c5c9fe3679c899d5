"""Mean and standard deviation of rows that come in parts."""

from __future__ import annotations

import torch
from torch import Tensor


class RunningMoments:
    """Mean and standard deviation along the first dimension of all parts, as if they had come together.

    Source: Chan, Golub, LeVeque 1983.
    """

    def __init__(self) -> None:
        self.count = 0
        self.mean = torch.zeros(())
        self._squared = torch.zeros(())

    def add(self, part: Tensor) -> None:
        """Takes up rows (B,...), float64."""
        count, mean = len(part), part.mean(0)
        squared = (part - mean).square().sum(0)
        if not self.count:
            self.count, self.mean, self._squared = count, mean, squared
            return
        away, total = mean - self.mean, self.count + count
        self._squared = self._squared + squared + away.square() * (self.count * count / total)
        self.mean = self.mean + away * (count / total)
        self.count = total

    def std(self) -> Tensor:
        """Of the sample, as ``Tensor.std``."""
        return (self._squared / (self.count - 1)).sqrt()
