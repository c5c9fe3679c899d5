"""Motion of weights without a dynamics prior: a random walk; hidden shapes follow the face's other side, or rest."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.capture.antagonist_shapes import signed_quantities
from torchface.capture.energy import Quadratic
from torchface.errors import ShapeError, ValueRangeError
from torchface.shape_names import mirror

HOLD, RELAXATION = 0.3, 0.3
"""Seconds that a hidden shape keeps its weight, and those in which it then falls to 1/e: at rest within about one."""
_FOLLOWING = 0.03  # seconds in which a hidden shape comes to 1/e of its distance from its twin: lids are so quick
HIDDEN = 0.25
"""Share of a shape's evidence, under which it counts as hidden."""
# Of the random walk's variance: a shape without evidence is not led off by what others do.
_LEAST_SHARE = 0.02
_LEAST_TRUST = 0.05
_SURE = 0.15  # standard deviation of a reading of a weight that counts as half of the evidence
_JUMP = 0.15  # of a weight, from which a reading that differs says that it moved


def relative_trust(trust: Tensor) -> Tensor:
    """How much landmarks count, (B,68) in [0,1], beside their frame's surest: a blurred face hides nothing."""
    trust = trust.clamp(0, 1)
    return trust / trust.amax(1, keepdim=True).clamp(min=_LEAST_TRUST)


def read_evidence(read: Quadratic, weights: Tensor) -> Tensor:
    """The share of evidence, (B,N) in [0,1], that readings of weights are beside those of the frame before (B,N).

    Of an eye whose lids' landmarks are doubted, as behind glasses, networks still say that it blinks. Small differences
    are their noise.
    """
    information = read.H.diagonal(dim1=1, dim2=2)
    jump = ((read.H @ weights[..., None])[..., 0] + read.f).abs() / information.clamp(min=1e-9)
    return information / (information + 1 / _SURE**2) * ((jump - _JUMP) / _JUMP).clamp(0, 1)


def unseen_time(before: Tensor | None, evidence: Tensor, interval: float | Tensor) -> Tensor:
    """For how long shapes have been hidden, (B,N), seconds, by that ``before`` and the share of their evidence that
    is seen."""
    since = torch.zeros_like(evidence) if before is None else before
    return torch.where(evidence < HIDDEN, since + interval, 0.0)


def twins_of(names: Sequence[str]) -> Tensor:
    """For each shape its mirror image on the face's other side, (N,) int64, itself where there is none.

    Antagonists are none: a jaw is left or right, and eyes look aside together.
    """
    twins = mirror(names)
    alone = signed_quantities(names).abs()
    sides = torch.arange(len(names))
    looks = torch.tensor(["look" in name.lower() for name in names])
    opposed = (alone.T @ alone)[sides, twins] > 0
    return torch.where((opposed & (twins != sides)) | looks, sides, twins)


def expected_weights(
    weights: Tensor, evidence: Tensor, hidden: Tensor, interval: float | Tensor, twins: Tensor
) -> Tensor:
    """The weights (B,N) that the frame before leads to: seen ones stay; hidden ones come to those of the face's
    other side while that is seen, and else go to rest after ``HOLD`` seconds."""
    rested = weights * (-(hidden - HOLD).clamp(min=0).clamp(max=interval) / RELAXATION).exp()
    own = torch.arange(len(twins), device=twins.device)
    followed = (hidden > 0) & (evidence[:, twins] >= HIDDEN) & (twins != own)
    kept = torch.exp(-torch.as_tensor(interval).to(weights) / _FOLLOWING)
    return torch.where(followed, kept * weights + (1 - kept) * weights[:, twins], rested)


def counted_share(evidence: Tensor) -> Tensor:
    """How much a network's reading of shapes counts, (B,N), beside one of a shape that is seen: of what is hidden it
    reads what its training had most."""
    return (evidence / HIDDEN).clamp(_LEAST_SHARE, 1.0)


def walk_information(variance: Tensor, evidence: Tensor, interval: float | Tensor) -> Tensor:
    """How certain the last frame's weights make this one's, one over a variance, (B,N), of a walk of ``variance`` a
    second."""
    return 1 / (variance * interval * counted_share(evidence))


def frame_intervals(seconds: Tensor | None, count: int, interval: float) -> list[float]:
    """Seconds (T,) from the frame before to each of T frames; the first frame has the usual interval."""
    if seconds is None:
        return [interval] * count
    if seconds.shape != (count,):
        raise ShapeError(f"seconds: found {tuple(seconds.shape)}, expected ({count},)")
    steps = seconds.detach().double().diff()
    if not bool((steps > 0).all()):
        raise ValueRangeError(f"seconds: found a step of {float(steps.min()):g}, expected times that rise")
    return [interval, *steps.tolist()]
