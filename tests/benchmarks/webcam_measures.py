"""How weights solved from a webcam compare with the truth: size, lag, tremor, blinks, gaze, and finding a lost face."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from planted.landmark_measures import Agreement, agreement
from torchface.shape_names import ARKIT
from train.rendered_people.people import Person, closed_lids

LIDS = [ARKIT.index("eyeBlinkRight"), ARKIT.index("eyeBlinkLeft")]
SIGNALS = {
    "mouth open": {"jawOpen": 1.0},
    "smile": {"mouthSmileLeft": 0.5, "mouthSmileRight": 0.5},
    "brows": {"browInnerUp": 0.5, "browOuterUpLeft": 0.25, "browOuterUpRight": 0.25}
    | {"browDownLeft": -0.5, "browDownRight": -0.5},
    "lids": {"eyeBlinkLeft": 0.5, "eyeBlinkRight": 0.5},
}
"""What a region does as one number: sums of weights."""
_MOVES = 0.05  # a shape whose weight stays in a narrower range does not move
_RESTS = 0.004  # of a weight's second difference in the truth
_BLINK, _SHUT = 0.6, 0.5  # a blink's highest weight; a weight from which lids count as shut
_LATE = 3  # frames that a blink may be found too early or too late
_LAGS = 8  # frames
_EACH = 3  # frames of which one is measured in millimetres


def region(*starts: str) -> Tensor:
    """Which of ARKit's shapes begin with one of some words, (52,) bool."""
    return torch.tensor([name.startswith(starts) for name in ARKIT])


REGIONS = {
    "all": ~region("eyeLook"),
    "eyes": region("eyeBlink", "eyeSquint", "eyeWide"),
    "brows": region("brow"),
    "mouth": region("mouth", "jaw"),
}


def moving(truth: Tensor) -> Tensor:
    """Which shapes the truth (T,52) moves, (52,) bool."""
    return truth.amax(0) - truth.amin(0) > _MOVES


def weight_error(solved: Tensor, truth: Tensor, shapes: Tensor, seen: Tensor) -> float:
    """Root mean square over the shapes (52,) that the truth (T,52) moves and frames (T,) that show a face."""
    shapes = shapes & moving(truth)
    difference = (solved - truth)[seen][:, shapes]
    return float(difference.square().mean().sqrt())


def vertex_error(person: Person, solved: Tensor, truth: Tensor, seen: Tensor) -> float:
    """Mean distance, millimetres, of the face's vertices of the person's own rig at solved and at true weights."""
    kind = person.kind
    place = kind.canonical
    face = kind.outer & (place[:, 2] > 15) & (place[:, 1] > -110) & (place[:, 1] < 60)
    errors = []
    for number in seen.nonzero()[::_EACH, 0].tolist():  # lids that meet are a frame's own
        both = (closed_lids(kind, person.head, weights[number].clamp(0, 1))[face] for weights in (solved, truth))
        errors.append((next(both) - next(both)).norm(dim=1).mean())
    return float(torch.stack(errors).mean())


def signal(weights: Tensor, name: str) -> Tensor:
    """One of ``SIGNALS`` of weights (T,52), (T,)."""
    return sum(  # type: ignore[return-value]
        share * weights[:, ARKIT.index(shape)] for shape, share in SIGNALS[name].items()
    )


def follows(solved: Tensor, truth: Tensor, name: str, seen: Tensor) -> Agreement:
    """How one of ``SIGNALS`` follows the truth: correlation and slope, over frames (T,) that show a face."""
    return agreement(signal(solved, name)[seen], signal(truth, name)[seen])


def lag(solved: Tensor, truth: Tensor, seen: Tensor) -> float:
    """Frames by which weights (T,52) come late: where their cross-correlation with the truth is highest.

    Of changes from frame to frame of the shapes that the truth moves, over frames that show a face; interpolated
    between whole frames.
    """
    shapes = moving(truth) & ~region("eyeLook")
    change, true = solved[:, shapes].diff(dim=0), truth[:, shapes].diff(dim=0)
    steady = seen[1:] & seen[:-1]
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


def tremor(solved: Tensor, truth: Tensor, seen: Tensor) -> float:
    """Root mean square of weights' second differences where the truth's (T,52) rest."""
    own, true = solved.diff(n=2, dim=0), truth.diff(n=2, dim=0)
    wide = torch.nn.functional.max_pool1d(true.abs().T[None], 5, 1, 2)[0].T  # the frames beside too
    still = (wide < _RESTS) & (seen[2:] & seen[1:-1] & seen[:-2])[:, None] & ~region("eyeLook")
    return float(own[still].square().mean().sqrt())


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

    def __add__(self, other: BlinkCount) -> BlinkCount:
        return BlinkCount(
            self.true + other.true, self.found + other.found, self.reported + other.reported, self.false + other.false
        )


def blinks(solved: Tensor, truth: Tensor, seen: Tensor) -> BlinkCount:
    """Counts blinks of weights (T,52): lids whose weight rises over 0.6 in the truth, over 0.5 in what was solved."""
    true, own = (weights[:, LIDS].mean(1).masked_fill(~seen, 0.0).nan_to_num(0.0) for weights in (truth, solved))
    real = [(a, b) for a, b in _runs(true > _SHUT) if float(true[a : b + 1].max()) > _BLINK]
    told = _runs(own > _SHUT)
    found = sum(any(_meets(one, other) for other in told) for one in real)
    half = _runs(true > 0.8 * _SHUT)
    false = sum(not any(_meets(one, other) for other in half) for one in told)
    return BlinkCount(len(real), found, len(told), false)


def _runs(mask: Tensor) -> list[tuple[int, int]]:
    """First and last frame of each run of a mask (T,)."""
    change = torch.nn.functional.pad(mask.to(torch.int8), (1, 1)).diff()
    starts, ends = (change == 1).nonzero()[:, 0].tolist(), (change == -1).nonzero()[:, 0].tolist()
    return [(start, end - 1) for start, end in zip(starts, ends, strict=True)]


def _meets(one: tuple[int, int], other: tuple[int, int]) -> bool:
    return one[0] - _LATE <= other[1] and other[0] <= one[1] + _LATE


def gaze_error(solved: Tensor, truth: Tensor, opened: Tensor) -> float:
    """Mean angle, degrees, between gazes (T,2,2) in radians, over eyes (T,2) that are open."""

    def way(gaze: Tensor) -> Tensor:
        across, up = gaze.double().unbind(-1)
        return torch.stack([across.sin() * up.cos(), up.sin(), across.cos() * up.cos()], -1)

    cosine = (way(solved) * way(truth)).sum(-1).clamp(-1, 1)[opened]
    return float(torch.rad2deg(cosine.acos()).mean())


def recovery(solved: Tensor, truth: Tensor, present: Tensor) -> list[float]:
    """Frames from each return of a face until its weights are as near to the truth as they mostly are.

    As near: the mean distance over shapes that move is under one and a half times its median for three frames on end.
    """
    distance = (solved - truth)[:, moving(truth) & ~region("eyeLook")].abs().mean(1)
    good = distance < 1.5 * distance[present].nanmedian()
    took = []
    for start, end in _runs(~present):
        if start == 0 or end + 4 >= len(present):
            continue
        settled = [t for t in range(end + 1, len(good) - 2) if bool(good[t : t + 3].all())]
        took.append(float(settled[0] - end - 1) if settled else math.inf)
    return took
