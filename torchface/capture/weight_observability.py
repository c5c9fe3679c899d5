"""Observability of weights by points on a face: rank, conditioning, and shapes that look alike."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.escaped_text import listed

# What a report prints of each confusion, and how many of them; the tuples hold all.
_SHOWN_SHAPES, _SHOWN_CONFUSIONS = 4, 8


@dataclass(frozen=True)
class Confusion:
    """A change of several weights that the points do not see."""

    names: tuple[str, ...]  # the shapes that take part most, with their signed weights in direction
    direction: tuple[float, ...]  # a unit change of the weights, the entries that belong to names
    moves: float  # how far that change moves the points, root mean square, in unit
    points: str = "markers"  # what they are called
    unit: str = "mm"  # of moves

    def __str__(self) -> str:
        pairs = list(zip(self.direction, self.names, strict=True))
        parts = " ".join(f"{weight:+.2f} {name}" for weight, name in pairs[:_SHOWN_SHAPES])
        more = f" and {len(pairs) - _SHOWN_SHAPES} more" if len(pairs) > _SHOWN_SHAPES else ""
        return f"{parts}{more}: moves the {self.points} {self.moves:.3f} {self.unit}"


@dataclass(frozen=True)
class Observability:
    """What a layout of points sees.

    Args:
        shapes, count: how many shapes there are, and points.
        rank: of B, (CM,N): singular directions that move the points more than rounding.
        visible: singular directions that move the points by at least ``noise``.
        condition: largest over smallest singular value of B; infinite if rank is less than ``shapes``.
        noise: what counts as seen, root mean square over the points, in ``unit``.
        unseen: shapes whose full activation moves the points by less than ``noise``.
        ambiguous: shapes whose motion of the points the other shapes imitate to within ``noise``.
        confusions: one for each singular direction that is not visible and not of a single unseen shape, weakest first.
        points: what they are called.
        unit: of ``noise``.

    Example:
        >>> basis = torch.tensor([[[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]]])  # one point, which two shapes move alike
        >>> weight_observability(basis, ["jawOpen", "mouthClose"], noise=0.1).ambiguous
        ('jawOpen', 'mouthClose')
    """

    shapes: int
    count: int
    rank: int
    visible: int
    condition: float
    noise: float
    unseen: tuple[str, ...]
    ambiguous: tuple[str, ...]
    confusions: tuple[Confusion, ...]
    points: str = "markers"
    unit: str = "mm"

    def __str__(self) -> str:
        clear = self.shapes - len({*self.unseen, *self.ambiguous})
        lines = [
            f"the {self.points} show {clear} of the {self.shapes} shapes clearly; {len(self.unseen)} they do not see, "
            f"{len(self.ambiguous)} look to them like others: their curves are not reliable",
            f"{self.count} {self.points} see {self.visible} of {self.shapes} directions of the weights above "
            f"{self.noise:g} {self.unit}; rank {self.rank}, condition {self.condition:.3g}",
        ]
        if self.unseen:
            lines.append(f"not seen: {listed(self.unseen, 12)}")
        if self.ambiguous:
            lines.append(f"cannot be distinguished from the other shapes: {listed(self.ambiguous, 12)}")
        if self.confusions:
            lines.append("changes of the weights that do not show:")
            lines.extend(f"  {confusion}" for confusion in self.confusions[:_SHOWN_CONFUSIONS])
        if len(self.confusions) > _SHOWN_CONFUSIONS:
            lines.append(f"  and {len(self.confusions) - _SHOWN_CONFUSIONS} more")
        return "\n".join(lines)


def weight_observability(
    basis: Tensor, names: Sequence[str], noise: float, points: str = "markers", unit: str = "mm"
) -> Observability:
    r"""What points see of the weights that move them.

    A change d of the weights moves M points by :math:`\lVert B d \rVert / \sqrt{M}`, root mean square. The singular
    vectors of B are the directions from the best to the worst seen; where several shapes share one that is not seen,
    the points cannot say which of them moved, and the regularisation decides.

    Args:
        basis: B, (M,C,N).
        names: of the N shapes.
        noise: a direction whose unit change moves the points less is not seen.

    Source: thesis 4.1.4: the rank of B should be at least N.
    """
    rows = basis.double().flatten(0, 1)
    count, shapes = len(basis), rows.shape[1]
    values, directions = _directions(rows)
    moves = values / count**0.5
    floor = float(values.max()) * max(rows.shape) * torch.finfo(torch.float64).eps
    # The basis itself came in float32, if it did: its rounding must not count as rank.
    floor = max(floor, float(values.max()) * torch.finfo(basis.dtype).eps)
    rank = int((values > floor).sum())
    size = rows.norm(dim=0) / count**0.5
    # The distance of a column of B to the span of the others is 1 / sqrt of the diagonal of the inverse of B'B.
    alone = (directions.square() / values.clamp(min=floor)[:, None].square()).sum(0).rsqrt() / count**0.5
    unseen = tuple(name for name, moved in zip(names, size.tolist(), strict=True) if moved < noise)
    imitated = zip(names, alone.tolist(), strict=True)
    ambiguous = tuple(name for name, moved in imitated if moved < noise and name not in unseen)
    confusions = []
    for row in reversed(range(int((moves >= noise).sum()), shapes)):
        confusion = _confusion(directions[row], float(moves[row]), tuple(names), points, unit)
        if len(confusion.names) > 1 or confusion.names[0] not in unseen:
            confusions.append(confusion)
    condition = float(values[0] / values[-1]) if rank == shapes else float("inf")
    return Observability(
        shapes,
        count,
        rank,
        int((moves >= noise).sum()),
        condition,
        noise,
        unseen,
        ambiguous,
        tuple(confusions),
        points,
        unit,
    )


def _directions(rows: Tensor) -> tuple[Tensor, Tensor]:
    """All N singular values, zeros included, and the directions (N,N) as rows."""
    _, values, directions = torch.linalg.svd(rows, full_matrices=True)
    padded = values.new_zeros(rows.shape[1])
    padded[: len(values)] = values
    return padded, directions


def _confusion(direction: Tensor, moves: float, names: tuple[str, ...], points: str, unit: str) -> Confusion:
    """The entries that make up nine tenths of a unit vector, largest first and that one positive."""
    order = direction.abs().argsort(descending=True)
    share = direction[order].square().cumsum(0)
    count = int((share < 0.9).sum()) + 1
    taken = order[:count]
    signed = direction * torch.sign(direction[order[0]])
    return Confusion(tuple(names[i] for i in taken.tolist()), tuple(signed[taken].tolist()), moves, points, unit)
