"""The leading principal components of any number of samples, in passes over them: time and memory linear in both."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.files.checkpoints import read_checkpoint, write_checkpoint

SUBSPACE = "subspace.safetensors"
_SEED = 0
_MAX_PASSES = 30
_SETTLED = 1e-6
"""Relative change of a variance from one pass to the next, below which all have settled."""


@dataclass(frozen=True, eq=False)
class LeadingComponents:
    """What samples vary in most.

    Args:
        values: eigenvalues of the scatter matrix, the largest first, (K,) float64.
        vectors: its orthonormal eigenvectors, (K,D) float64.
        trace: the sum of all eigenvalues.
        passes: over the samples.
    """

    values: Tensor
    vectors: Tensor
    trace: float
    passes: int


def leading_components(
    read: Callable[[int, int], Tensor],
    parts: Sequence[tuple[int, int]],
    size: int,
    count: int,
    checkpoint: Path | None = None,
    key: str = "",
    report: Callable[[int, int], None] | None = None,
) -> LeadingComponents:
    r"""Subspace iteration on the scatter matrix, which is never made.

    .. math:: Z_p = Q_p X^\top X, \quad Q_{p+1} = \mathrm{orth}(Z_p)

    for centred samples X (M,D) and half as many rows Q more than components are wanted. Memory is two bases,
    :math:`24 K D` bytes, and a block of samples; a pass takes :math:`6 M D K` products. It ends when no eigenvalue
    changes by more than a millionth any more.

    Args:
        read: centred samples from one number up to another, without it, (N,D) float64.
        parts: begin and end of blocks that hold them all.
        size: D.
        count: K.
        checkpoint: a folder for the basis of each finished pass, from which a killed run goes on.
        key: of the samples.
        report: called with the blocks that are done and how many there are at most.

    Source: Halko, Martinsson, Tropp 2011, Finding structure with randomness, algorithm 4.4.
    """
    rows = min(size, max(count + count // 2, count + 10))
    file = None if checkpoint is None else checkpoint / SUBSPACE
    kept = None if file is None else read_checkpoint(file, key)
    if kept is not None and kept["basis"].shape == (rows, size):
        basis, values, passes = kept["basis"], kept["values"], int(kept["passes"])
    else:
        start = torch.randn(size, rows, generator=torch.Generator().manual_seed(_SEED), dtype=torch.float64)
        basis, values, passes = torch.linalg.qr(start).Q.T, torch.zeros(count, dtype=torch.float64), 0
    steps = _steps(report, passes * len(parts), _MAX_PASSES * len(parts))
    while True:
        applied, inside = torch.zeros(rows, size, dtype=torch.float64), torch.zeros(rows, rows, dtype=torch.float64)
        trace = 0.0
        for begin, end in parts:
            block = read(begin, end)
            coefficients = block @ basis.T
            applied.addmm_(coefficients.T, block)
            inside.addmm_(coefficients.T, coefficients)
            trace += float(block.square().sum())
            next(steps)
        held, turned = torch.linalg.eigh(inside)
        before, values = values, held[-count:].flip(0).clamp(min=0)
        passes += 1
        if passes >= _MAX_PASSES or bool(((values - before).abs() <= _SETTLED * values).all()):
            return LeadingComponents(values, turned[:, -count:].flip(1).T @ basis, trace, passes)
        basis = torch.linalg.qr(applied.T).Q.T
        if file is not None:
            write_checkpoint(file, {"basis": basis, "values": values, "passes": torch.tensor(passes)}, key)


def _steps(report: Callable[[int, int], None] | None, done: int, total: int) -> Iterator[None]:
    while True:
        done += 1
        if report is not None:
            report(done, total)
        yield
