"""Scores of expressions found in a film against the true weights of every frame."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.shape_names import ARKIT, antagonists, mapping

LIDS = [ARKIT.index("eyeBlinkRight"), ARKIT.index("eyeBlinkLeft")]
_BOTH = 0.1  # weight from which a shape is on
_MOVES = 0.05  # a shape whose weight stays in a narrower range does not move
_RESTS = 0.004  # of a weight's second difference in the truth
_REST, _ACTIVE = (
    0.02,
    0.05,
)  # weight under which a shape is at rest in the truth, and from which it is not in the result
_BLINK, _SHUT = 0.6, 0.5  # a blink's highest weight; a weight from which lids count as shut
_LATE = 3  # frames that a blink may be found too early or too late
_LAGS = 8  # frames


def shape_mask(*starts: str) -> Tensor:
    """Which of ARKit's shapes begin with one of some words, (52,) bool."""
    return torch.tensor([name.startswith(starts) for name in ARKIT])


REGIONS = {
    "all": ~shape_mask("eyeLook"),
    "eyes": shape_mask("eyeBlink", "eyeSquint", "eyeWide"),
    "brows": shape_mask("brow"),
    "mouth": shape_mask("mouth", "jaw"),
    "gaze": shape_mask("eyeLook"),
}
"""Shapes whose errors are given together; ``all`` are those of the face's skin."""


@dataclass(frozen=True)
class BlinkCount:
    """True blinks, how many of them were found, blinks that were reported, and how many of these are none."""

    true: int
    found: int
    reported: int
    false: int

    @property
    def recall(self) -> float:
        """Share of the true blinks that were found."""
        return self.found / self.true if self.true else math.nan

    @property
    def precision(self) -> float:
        """Share of the reported blinks that are true."""
        return 1 - self.false / self.reported if self.reported else math.nan

    def __add__(self, other: "BlinkCount") -> "BlinkCount":
        return BlinkCount(
            self.true + other.true, self.found + other.found, self.reported + other.reported, self.false + other.false
        )


@dataclass(frozen=True, eq=False)
class ExpressionScore:
    """How a film's weights compare with the truth; shapes are ARKit's 52."""

    moved: Tensor  # shapes that the truth moves by more than 0.05, (52,) bool
    supported: Tensor  # shapes that the method gives, (52,) bool
    # Of each shape that moves, (52,): 0 where the method gives none or a constant; NaN where it rests.
    correlation: Tensor
    slope: Tensor  # of the found weight over the true one, (52,); likewise
    error: Tensor  # root mean square, (52,); a shape that is not given counts as 0 in every frame
    restless: Tensor  # shapes that are never below 0.05 though the truth rests, (52,) bool
    lag: float  # milliseconds by which weights come late
    jitter: float  # of weights where the truth rests, as weight_jitter has it
    blinks: BlinkCount
    both: float  # share of frames with antagonists both above 0.1, which the truth does not have

    def region_error(self, region: str = "all") -> float:
        """Root mean square over the shapes of one of ``REGIONS`` that move; NaN where none does."""
        shapes = REGIONS[region] & self.moved
        return float(self.error[shapes].square().mean().sqrt())


def expression_score(found: Tensor, found_names: Sequence[str], true: Tensor, fps: float) -> ExpressionScore:
    """Compares a film's weights (T,N) with the true ones; in a lost face's frame of NaN the frame before stands.

    A column of NaN is a shape that the method does not support.
    """
    if found.ndim != 2 or true.shape != (len(found), len(ARKIT)) or len(found) < 3:
        raise ShapeError(
            f"weights: found {tuple(found.shape)} and {tuple(true.shape)}, expected (T,N) and (T,{len(ARKIT)}), T >= 3"
        )
    given = torch.isfinite(found).any(0)
    matrix = mapping(found_names, ARKIT).to(found.dtype)
    supported = (matrix[:, given] != 0).any(1)
    weights = (held(found[:, given]) @ matrix[:, given].T).double()
    true = true.double()
    moved = true.amax(0) - true.amin(0) > _MOVES
    a, b = weights - weights.mean(0), true - true.mean(0)
    both, own, truth = (a * b).mean(0), a.square().mean(0), b.square().mean(0)
    none = torch.where(moved, 0.0, torch.nan).double()
    correlation = torch.where(moved & (own > 1e-9), both / (own * truth).sqrt().clamp(min=1e-12), none)
    slope = torch.where(moved, both / truth.clamp(min=1e-12), none)
    restless = supported & (weights.amin(0) > _ACTIVE) & (true.amin(0) < _REST)
    error = (weights - true).square().mean(0).sqrt()
    jitter = tremor(weights[:, supported], true[:, supported]) / math.sqrt(6)
    return ExpressionScore(
        moved, supported, correlation.float(), slope.float(), error.float(), restless,
        1000 / fps * weight_lag(weights, true), jitter, blinks(weights, true),
        float((_together(weights) & ~_together(true)).any(1).double().mean()),
    )  # fmt: skip


def held(weights: Tensor) -> Tensor:
    """Weights (T,N) where NaN is the frame's before, and 0 before the first."""
    known = torch.isfinite(weights)
    rows = torch.where(known, torch.arange(len(weights))[:, None], -1).cummax(0).values
    return torch.where(rows >= 0, weights.gather(0, rows.clamp(min=0)), 0.0)


def _together(weights: Tensor) -> Tensor:
    """Which antagonists are both on, (T,P) bool."""
    first, second = antagonists(ARKIT).T
    return torch.minimum(weights[:, first], weights[:, second]) > _BOTH


def moving(truth: Tensor) -> Tensor:
    """Which shapes the truth (T,52) moves, (52,) bool."""
    return truth.amax(0) - truth.amin(0) > _MOVES


def weight_lag(solved: Tensor, truth: Tensor, seen: Tensor | None = None) -> float:
    """Frames by which weights (T,52) come late: where their cross-correlation with the truth is highest.

    Of changes from frame to frame of the shapes that the truth moves, over frames (T,) that show a face; interpolated
    between whole frames. NaN where nothing moves.
    """
    shapes = moving(truth) & ~REGIONS["gaze"]
    change, true = solved[:, shapes].diff(dim=0), truth[:, shapes].diff(dim=0)
    steady = torch.ones(len(change), dtype=torch.bool) if seen is None else seen[1:] & seen[:-1]
    if not (change[steady].abs() > 1e-6).any() or not (true[steady].abs() > 1e-6).any():
        return math.nan
    values = torch.tensor([_correlation(change, true, steady, shift) for shift in range(-_LAGS, _LAGS + 1)])
    best = int(values[1:-1].argmax()) + 1
    before, at, after = values[best - 1 : best + 2].tolist()
    bend = before - 2 * at + after
    return best - _LAGS + (0.5 * (before - after) / bend if bend < 0 else 0.0)


def _correlation(change: Tensor, true: Tensor, steady: Tensor, shift: int) -> float:
    """Correlation of changes (T,N) that come ``shift`` frames later with true ones."""
    count = len(true)
    rows = torch.arange(max(0, -shift), count - max(0, shift))
    rows = rows[steady[rows] & steady[rows + shift]]
    a, b = change[rows + shift], true[rows]
    return float((a * b).sum() / (a.square().sum() * b.square().sum()).sqrt().clamp(min=1e-12))


def tremor(solved: Tensor, truth: Tensor, seen: Tensor | None = None) -> float:
    """Root mean square of weights' second differences where the truth's (T,N) rest."""
    own, true = solved.diff(n=2, dim=0), truth.diff(n=2, dim=0)
    wide = torch.nn.functional.max_pool1d(true.abs().T[None], 5, 1, 2)[0].T  # the frames beside too
    still = wide < _RESTS
    if seen is not None:
        still = still & (seen[2:] & seen[1:-1] & seen[:-2])[:, None]
    return float(own[still].double().square().mean().sqrt())


def blinks(solved: Tensor, truth: Tensor, seen: Tensor | None = None) -> BlinkCount:
    """Counts blinks of weights (T,52): lids whose weight rises over 0.6 in the truth, over 0.5 in what was solved."""
    hidden = torch.zeros(len(truth), dtype=torch.bool) if seen is None else ~seen
    true, own = (weights[:, LIDS].mean(1).masked_fill(hidden, 0.0).nan_to_num(0.0) for weights in (truth, solved))
    real = [(a, b) for a, b in runs(true > _SHUT) if float(true[a : b + 1].max()) > _BLINK]
    reported = runs(own > _SHUT)
    found = sum(any(_meets(one, other) for other in reported) for one in real)
    half = runs(true > 0.8 * _SHUT)
    false = sum(not any(_meets(one, other) for other in half) for one in reported)
    return BlinkCount(len(real), found, len(reported), false)


def runs(mask: Tensor) -> list[tuple[int, int]]:
    """First and last frame of each run of a mask (T,)."""
    change = torch.nn.functional.pad(mask.to(torch.int8), (1, 1)).diff()
    starts, ends = (change == 1).nonzero()[:, 0].tolist(), (change == -1).nonzero()[:, 0].tolist()
    return [(start, end - 1) for start, end in zip(starts, ends, strict=True)]


def _meets(one: tuple[int, int], other: tuple[int, int]) -> bool:
    return one[0] - _LATE <= other[1] and other[0] <= one[1] + _LATE


@dataclass(frozen=True, eq=False)
class MethodScore:
    """A method's scores over films."""

    films: dict[str, ExpressionScore]

    def error(self, region: str = "all") -> float:
        """Root mean square error of shapes that move, mean over films in which some of the region do."""
        return _mean([film.region_error(region) for film in self.films.values()])

    def shape_mean(self, part: str) -> Tensor:
        """Mean over films in which a shape moves of its ``correlation``, ``slope`` or ``error``, (52,)."""
        rows = torch.stack([
            torch.where(film.moved, getattr(film, part), torch.nan) for film in self.films.values()
        ])  # fmt: skip
        return rows.nanmean(0)

    def typical(self, part: str, region: str = "all") -> float:
        """Median over shapes of a region of :meth:`shape_mean`."""
        return float(self.shape_mean(part)[REGIONS[region]].nanmedian())

    @property
    def lag(self) -> float:
        """Milliseconds, mean over films."""
        return _mean([film.lag for film in self.films.values()])

    @property
    def jitter(self) -> float:
        """Mean over films."""
        return _mean([film.jitter for film in self.films.values()])

    @property
    def blinks(self) -> BlinkCount:
        """Of all films."""
        return sum((film.blinks for film in self.films.values()), BlinkCount(0, 0, 0, 0))

    @property
    def both(self) -> float:
        """Share of frames with antagonists both on, mean over films."""
        return _mean([film.both for film in self.films.values()])

    @property
    def restless(self) -> tuple[str, ...]:
        """Shapes that never rest in a third of the films at least."""
        share = torch.stack([film.restless for film in self.films.values()]).float().mean(0)
        return tuple(name for name, value in zip(ARKIT, share.tolist(), strict=True) if value >= 1 / 3)

    @property
    def unsupported(self) -> tuple[str, ...]:
        """Shapes that the method gives in no film."""
        given = torch.stack([film.supported for film in self.films.values()]).any(0)
        return tuple(name for name, value in zip(ARKIT, given.tolist(), strict=True) if not value)


def _mean(values: Sequence[float]) -> float:
    kept = [value for value in values if math.isfinite(value)]
    return sum(kept) / len(kept) if kept else math.nan
