"""Windows of takes as the dynamics prior learns from them, a take at a time, and what adds up over a pass of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.priors.motion_features import windows_of

FOLDS = 4  # of a single take
_MOST_FOLDS = 100  # of several: what is kept of each fold is not to grow with the takes
_RIDGE = 1e-6  # of the coefficients, in squared weights
_POOLING = 0.02  # weight of the coefficients that all shapes share against each one's own


@dataclass(frozen=True, eq=False)
class Part:
    """Windows of a take, or of a quarter of the only one."""

    fold: int  # what is left out together with it
    begin: int  # number of its first window among all
    windows: Tensor  # (B,J,N), with the noise that the prior should expect
    following: Tensor  # (B,N)

    def steps(self, coefficients: Tensor) -> Tensor:
        """The step to the next frame less what the shapes' own frames predict, (B,N)."""
        return self.following - self.windows[:, -1] - (self.windows * coefficients).sum(1)

    def rows_of(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Which places of a list of windows' numbers (K,) are of this part, and their rows here, (K',) each."""
        places = ((numbers >= self.begin) & (numbers < self.begin + len(self.windows))).nonzero()[:, 0]
        return places, numbers[places] - self.begin


@dataclass(frozen=True, eq=False)
class TakeWindows:
    """The windows of takes, which are read anew in each pass, with the same noise each time."""

    takes: Sequence[Tensor]  # weights of each, (T,N); a list, or what reads them from a disk
    window: int  # J
    input_noise: float  # standard deviation of noise that is added to the windows
    seed: int

    @property
    def folds(self) -> int:
        """A fold is a take, of many takes a hundredth of them, neighbours together; of a single take a quarter."""
        return FOLDS if len(self.takes) == 1 else min(len(self.takes), _MOST_FOLDS)

    def parts(self, generator: torch.Generator | None = None) -> Iterator[Part]:
        """One after the other; where draws are to go on after the last part ``generator`` draws the noise."""
        generator = torch.Generator().manual_seed(self.seed) if generator is None else generator
        begin = 0
        for number, take in enumerate(map(torch.as_tensor, self.takes)):
            pair = windows_of(take.detach().double().cpu(), self.window)
            alone = len(self.takes) == 1
            pairs = zip(*(half.chunk(FOLDS) for half in pair), strict=True) if alone else iter([pair])
            for quarter, (windows, following) in enumerate(pairs):
                noise = torch.randn(windows.shape, generator=generator, dtype=torch.float64)
                fold = quarter if alone else number * self.folds // len(self.takes)
                yield Part(fold, begin, windows + self.input_noise * noise, following)
                begin += len(windows)


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


class Autoregression:
    """Normal equations of parts as they come, added up for each fold.

    A window at rest must stay at rest whatever the weights there, so the step is a linear function of the steps before:
    a shape that the takes never raised must not be drawn back to 0. The coefficients are pooled: each shape's are drawn
    toward those that fit all shapes.
    """

    def __init__(self, shapes: int, window: int, folds: int) -> None:
        self._squares = torch.zeros(folds, shapes, window - 1, window - 1, dtype=torch.float64)
        self._products = torch.zeros(folds, shapes, window - 1, dtype=torch.float64)

    def add(self, part: Part) -> None:
        """Takes up a part."""
        before = part.windows.diff(dim=1)
        self._squares[part.fold] += torch.einsum("bin,bjn->nij", before, before)
        self._products[part.fold] += torch.einsum("bin,bn->ni", before, part.following - part.windows[:, -1])

    def coefficients(self) -> tuple[Tensor, list[Tensor]]:
        """Those of frames, (J,N), from all parts, and from all but each fold."""
        square, product = self._squares.sum(0), self._products.sum(0)
        left_out = [_from_steps(square - a, product - b) for a, b in zip(self._squares, self._products, strict=True)]
        return _from_steps(square, product), left_out


def _from_steps(square: Tensor, product: Tensor) -> Tensor:
    """Coefficients (J,N) of frames, of normal equations (N,J-1,J-1), (N,J-1) of the steps between them."""
    count, steps = product.shape
    ridge = _RIDGE * torch.eye(steps, dtype=torch.float64)
    pooled = square.mean(0) + ridge
    common = torch.linalg.solve(pooled, product.mean(0))
    own = torch.linalg.solve(square + _POOLING * pooled, product + _POOLING * (pooled @ common))
    zero = torch.zeros(count, 1, dtype=torch.float64)
    padded = torch.cat([zero, own, zero], dim=1)
    return (padded[:, :-1] - padded[:, 1:]).T
