"""Windows of takes as the dynamics prior learns from them: a take at a time, in passes that are all the same."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.priors.motion_features import windows_of

FOLDS = 4  # of a single take
_MOST_FOLDS = 100  # of several: what is kept of each fold is not to grow with the takes


@dataclass(frozen=True, eq=False)
class Part:
    """Windows of a take, or of a quarter of the only one.

    Args:
        fold: what is left out together with it.
        begin: number of its first window among all.
        windows: (B,J,N), with the noise that the prior should expect.
        following: (B,N).
    """

    fold: int
    begin: int
    windows: Tensor
    following: Tensor

    def steps(self, coefficients: Tensor) -> Tensor:
        """The step to the next frame less what the shapes' own frames predict, (B,N)."""
        return self.following - self.windows[:, -1] - (self.windows * coefficients).sum(1)

    def rows_of(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Which places of a list of windows' numbers (K,) are of this part, and their rows here, (K',) each."""
        places = ((numbers >= self.begin) & (numbers < self.begin + len(self.windows))).nonzero()[:, 0]
        return places, numbers[places] - self.begin


@dataclass(frozen=True, eq=False)
class TakeWindows:
    """The windows of takes, which are read anew in each pass, with the same noise each time.

    Args:
        takes: weights of each, (T,N); a list, or what reads them from a disk.
        window: J.
        input_noise: standard deviation of noise that is added to the windows.
        seed: of the noise.
    """

    takes: Sequence[Tensor]
    window: int
    input_noise: float
    seed: int

    @property
    def folds(self) -> int:
        """A fold is a take, of many takes a hundredth of them, neighbours together; of a single take a quarter."""
        return FOLDS if len(self.takes) == 1 else min(len(self.takes), _MOST_FOLDS)

    def parts(self, generator: torch.Generator | None = None) -> Iterator[Part]:
        """One after the other.

        Args:
            generator: of the noise, as the seed makes it; where draws are to go on after the last part.
        """
        generator = torch.Generator().manual_seed(self.seed) if generator is None else generator
        begin = 0
        for number, take in enumerate(self.takes):
            pair = windows_of(take.detach().double().cpu(), self.window)
            alone = len(self.takes) == 1
            pairs = zip(*(half.chunk(FOLDS) for half in pair), strict=True) if alone else iter([pair])
            for quarter, (windows, following) in enumerate(pairs):
                noise = torch.randn(windows.shape, generator=generator, dtype=torch.float64)
                fold = quarter if alone else number * self.folds // len(self.takes)
                yield Part(fold, begin, windows + self.input_noise * noise, following)
                begin += len(windows)
