"""What a marker layout can see of a rig: rank, conditioning and the shapes it cannot tell apart."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.markers.marker_solver import MarkerSolver

# What a report prints of each confusion, and how many of them; the tuples hold all.
_SHOWN_SHAPES, _SHOWN_CONFUSIONS = 4, 8


@dataclass(frozen=True)
class Confusion:
    """A change of several weights that the markers do not see.

    Args:
        names: the shapes that take part most, with their signed weights in ``direction``.
        direction: a unit change of the weights, the entries that belong to ``names``.
        moves: how far that change moves the markers, root mean square, millimetres.
    """

    names: tuple[str, ...]
    direction: tuple[float, ...]
    moves: float

    def __str__(self) -> str:
        pairs = list(zip(self.direction, self.names, strict=True))
        parts = " ".join(f"{weight:+.2f} {name}" for weight, name in pairs[:_SHOWN_SHAPES])
        more = f" and {len(pairs) - _SHOWN_SHAPES} more" if len(pairs) > _SHOWN_SHAPES else ""
        return f"{parts}{more}: moves the markers {self.moves:.3f} mm"


@dataclass(frozen=True)
class Observability:
    """What a layout sees.

    Args:
        shapes, markers: how many there are.
        rank: of B, (3M,N): singular directions that move the markers more than rounding.
        visible: singular directions that move the markers by at least ``noise``.
        condition: largest over smallest singular value of B; infinite if rank is less than ``shapes``.
        noise: what counts as seen, root mean square over the markers, millimetres.
        unseen: shapes whose full activation moves the markers by less than ``noise``.
        ambiguous: shapes whose motion of the markers the other shapes imitate to within ``noise``.
        confusions: one for each singular direction that is not visible and not of a single unseen shape, weakest first.
    """

    shapes: int
    markers: int
    rank: int
    visible: int
    condition: float
    noise: float
    unseen: tuple[str, ...]
    ambiguous: tuple[str, ...]
    confusions: tuple[Confusion, ...]

    def __str__(self) -> str:
        lines = [
            f"{self.markers} markers see {self.visible} of {self.shapes} directions of the weights above "
            f"{self.noise:g} mm; rank {self.rank}, condition {self.condition:.3g}"
        ]
        if self.unseen:
            lines.append(f"not seen: {', '.join(self.unseen)}")
        if self.ambiguous:
            lines.append(f"cannot be told from the other shapes: {', '.join(self.ambiguous)}")
        if self.confusions:
            lines.append("changes of the weights that do not show:")
            lines.extend(f"  {confusion}" for confusion in self.confusions[:_SHOWN_CONFUSIONS])
        if len(self.confusions) > _SHOWN_CONFUSIONS:
            lines.append(f"  and {len(self.confusions) - _SHOWN_CONFUSIONS} more")
        return "\n".join(lines)


def observability(solver: MarkerSolver, noise: float = 0.1) -> Observability:
    r"""What the markers of a solver can see of its rig.

    A change d of the weights moves the markers by :math:`\lVert B d \rVert / \sqrt{M}`, root mean square. The singular
    vectors of B are the directions from the best to the worst seen; where several shapes share one that is not seen,
    the markers cannot say which of them moved, and the regularisation decides.

    Args:
        solver: rig and attachment.
        noise: millimetres; a direction whose unit change moves the markers less drowns in it.

    Source: thesis 4.1.4: the rank of B should be at least N.
    """
    rows = solver.basis.double().flatten(0, 1)
    markers, shapes = len(solver.basis), rows.shape[1]
    values, directions = _directions(rows)
    moves = values / markers**0.5
    floor = float(values.max()) * max(rows.shape) * torch.finfo(torch.float64).eps
    # The basis itself came in float32, if it did: its rounding must not count as rank.
    floor = max(floor, float(values.max()) * torch.finfo(solver.basis.dtype).eps)
    rank = int((values > floor).sum())
    size = rows.norm(dim=0) / markers**0.5
    # The distance of a column of B to the span of the others is 1 / sqrt of the diagonal of the inverse of B'B.
    alone = (directions.square() / values.clamp(min=floor)[:, None].square()).sum(0).rsqrt() / markers**0.5
    unseen = tuple(name for name, moved in zip(solver.names, size.tolist(), strict=True) if moved < noise)
    imitated = zip(solver.names, alone.tolist(), strict=True)
    ambiguous = tuple(name for name, moved in imitated if moved < noise and name not in unseen)
    confusions = []
    for row in reversed(range(int((moves >= noise).sum()), shapes)):
        confusion = _confusion(directions[row], float(moves[row]), solver.names)
        if len(confusion.names) > 1 or confusion.names[0] not in unseen:
            confusions.append(confusion)
    condition = float(values[0] / values[-1]) if rank == shapes else float("inf")
    return Observability(
        shapes,
        markers,
        rank,
        int((moves >= noise).sum()),
        condition,
        noise,
        unseen,
        ambiguous,
        tuple(confusions),
    )


def _directions(rows: Tensor) -> tuple[Tensor, Tensor]:
    """All N singular values, zeros included, and the directions (N,N) as rows."""
    _, values, directions = torch.linalg.svd(rows, full_matrices=True)
    padded = values.new_zeros(rows.shape[1])
    padded[: len(values)] = values
    return padded, directions


def _confusion(direction: Tensor, moves: float, names: tuple[str, ...]) -> Confusion:
    """The entries that make up nine tenths of a unit vector, largest first and that one positive."""
    order = direction.abs().argsort(descending=True)
    share = direction[order].square().cumsum(0)
    count = int((share < 0.9).sum()) + 1
    taken = order[:count]
    signed = direction * torch.sign(direction[order[0]])
    return Confusion(tuple(names[i] for i in taken.tolist()), tuple(signed[taken].tolist()), moves)
