r"""Active sets for quadratic programs on the simplex, in batches: small exact systems of the few variables that count.

Source: Wolfe 1976, Finding the nearest point in a polytope; Portugal, Judice, Vicente 1994, A comparison of block
pivoting and interior-point algorithms for linear least squares problems with nonnegative variables.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

_PROXIMAL = 1e-9  # of H's largest diagonal: makes the active set's system definite; repeated, it leaves no trace
_REPEATS, _TRIES = 4, 6
_STEADY = 1e-13  # change of every value in a repeat after which there is no other
_SEVERAL, _NEARLY = 6, 0.3  # variables that enter at once at most, by their share of what the best one gives
_EXCHANGES = 6  # rounds in which several variables change sides at once; where they do not end, one does at a time
_INSIDE = 0.1  # of the tolerance: how exactly the candidates' own problem is solved
_MINOR = 60  # how often variables may leave between two that come
_CHUNK_NUMBERS = 2**24  # of the widest array, in all problems of a chunk


@dataclass(frozen=True, eq=False)
class SimplexProblems:
    """Problems of which several may share a matrix."""

    rows: Tensor  # of all matrices, one below the other, (G·N,N) float64
    first: Tensor  # each problem's first row, (B,) int64
    f: Tensor  # (B,N)
    limit: Tensor  # on the residual of each, (B,)

    def __getitem__(self, some: Tensor) -> SimplexProblems:
        return SimplexProblems(self.rows, self.first[some], self.f[some], self.limit[some])

    def gradient(self, x: Mixture) -> Tensor:
        """H x + f, (B,N)."""
        bent = embedding_bag(self.first[:, None] + x.index, self.rows, per_sample_weights=x.value, mode="sum")
        return bent + self.f


@dataclass(frozen=True, eq=False)
class Mixture:
    """Points of the simplex by their positive variables, K places each."""

    index: Tensor  # of variables, (B,K); a place that is free repeats another
    value: Tensor  # of theirs, (B,K), of sum 1; 0 in free places

    def __getitem__(self, some: Tensor) -> Mixture:
        return Mixture(self.index[some], self.value[some])

    @staticmethod
    def of(x: Tensor) -> Mixture:
        """Points (B,N) in as few places as the fullest needs; scaled to a sum of 1."""
        most = max(1, int((x > 0).sum(1).max())) if len(x) else 1
        value, place = x.topk(most, dim=1)
        return Mixture(torch.where(value > 0, place, place[:, :1]), value / value.sum(1, keepdim=True))

    def dense(self, variables: int) -> Tensor:
        """(B,N)."""
        return self.value.new_zeros(len(self.value), variables).scatter_add_(1, self.index, self.value)


def solve_simplex(problems: SimplexProblems, start: Mixture) -> Tensor:
    r"""The minimisers (B,N), exact.

    The variables whose gradients lie furthest below the multiplier :math:`x^\top g` join those that take part, the
    problem among these candidates alone is solved exactly, and so on until none lies below. As it includes what took
    part, it always lowers the energy, so no set comes twice.
    """
    variables = problems.f.shape[1]
    chunk = max(1, _CHUNK_NUMBERS // max(variables, (start.index.shape[1] + _SEVERAL) ** 2))
    parts = torch.arange(len(problems.f), device=problems.f.device).split(chunk)
    pieces = [_solve(problems[some], start[some]) for some in parts]
    return torch.cat(pieces)


def _solve(problems: SimplexProblems, x: Mixture) -> Tensor:
    count, variables = problems.f.shape
    solution = torch.zeros_like(problems.f)
    going = torch.arange(count, device=solution.device)
    if x.index.shape[1] > 1:
        x = _lowered(problems, x, x.index[:, :0], x.index[:, :0] > 0)
    for _ in range(40 * variables + 100):
        gradient = problems.gradient(x)
        multiplier = (x.value * gradient.gather(1, x.index)).sum(1, keepdim=True)
        slack = (gradient - multiplier).scatter_(1, x.index, 0.0)
        least = slack.amin(1)
        unsolved = least < -problems.limit
        if not bool(unsolved.all()):
            solution[going[~unsolved]] = x[~unsolved].dense(variables)
            rows = unsolved.nonzero()[:, 0]
            if not len(rows):
                return solution
            going, problems, x, slack, least = going[rows], problems[rows], x[rows], slack[rows], least[rows]
        best = slack.topk(min(_SEVERAL, variables), dim=1, largest=False)
        x = _lowered(problems, x, best.indices, best.values < _NEARLY * least[:, None])
    solution[going] = x.dense(variables)
    return solution


def _lowered(problems: SimplexProblems, x: Mixture, entering: Tensor, enters: Tensor) -> Mixture:
    """The minimum among the variables above 0 and those of ``entering`` (B,E), best first, that ``enters`` names."""
    index = torch.cat([x.index, entering], dim=1)
    candidates = _Candidates(
        problems.rows[(problems.first[:, None] + index)[:, :, None], index[:, None, :]],
        problems.f.gather(1, index),
        torch.cat([x.value > 0, enters], dim=1),
        torch.cat([x.value, torch.zeros_like(enters, dtype=x.value.dtype)], dim=1),
    )
    found, solved = _by_exchange(candidates, _INSIDE * problems.limit)
    left = (~solved).nonzero()[:, 0]
    if len(left):
        few = candidates[left]
        few.taken[:, x.index.shape[1] + 1 :] = False  # several may hinder each other and all leave again; one does not
        found[left] = _one_by_one(few)
    own = Mixture.of(found)
    return Mixture(index.gather(1, own.index), own.value)


@dataclass
class _Candidates:
    """Variables that may take part, K places a problem."""

    H: Tensor  # between them, (B,K,K)
    f: Tensor  # of them, (B,K)
    taken: Tensor  # which take part, (B,K) bool
    value: Tensor  # (B,K), 0 where not taken

    def __getitem__(self, some: Tensor) -> _Candidates:
        return _Candidates(self.H[some], self.f[some], self.taken[some], self.value[some])


def _by_exchange(candidates: _Candidates, limit: Tensor) -> tuple[Tensor, Tensor]:
    """The minimum among candidates, (B,K), and where it was found, (B,) bool.

    All variables below 0 leave and all whose gradients lie below the multiplier come, again and again. That nearly
    always ends in few rounds, at the minimum.
    """
    found = candidates.value.clone()
    solved = torch.zeros(len(found), dtype=torch.bool, device=found.device)
    rows, part, allowed = torch.arange(len(found), device=found.device), candidates, candidates.taken
    for _ in range(_EXCHANGES):
        aim = _equality_minimum(part)
        gradient = torch.bmm(part.H, aim[..., None])[..., 0] + part.f
        multiplier = (aim * gradient).sum(1)
        below = allowed & (gradient < (multiplier - limit)[:, None])
        wrong = torch.where(part.taken, aim < 0, below)
        done = ~wrong.any(1)
        found[rows[done]], solved[rows[done]] = aim[done], True
        left = (~done).nonzero()[:, 0]
        if not len(left):
            break
        rows, part, allowed, limit = rows[left], part[left], allowed[left], limit[left]
        part.taken = part.taken ^ wrong[left]
        kept = aim[left].clamp(min=0).masked_fill(~part.taken, 0.0)
        part.value = kept / kept.sum(1, keepdim=True)
    return found, solved


def _one_by_one(active: _Candidates) -> Tensor:
    """The minimum among those that take part, (B,K), without those that a step towards it takes below 0."""
    for _ in range(_MINOR + active.value.shape[1]):
        aim = _equality_minimum(active)
        step = aim - active.value
        falls = active.taken & (aim <= 0) & (step < 0)
        room = torch.where(falls, active.value / (-step).clamp(min=1e-300), torch.inf)
        length = room.amin(1).clamp(max=1.0)
        leaves = falls & (room <= length[:, None])
        value = torch.where(active.taken & ~leaves, active.value + length[:, None] * step, 0.0).clamp(min=0)
        active.value = value / value.sum(1, keepdim=True)
        active.taken = active.taken & ~leaves
        # What stood at 0 and would fall leaves without a step; the others have moved.
        if not bool(leaves.any()):
            break
    return active.value


def _equality_minimum(active: _Candidates) -> Tensor:
    """The minimum with the sum alone kept, (B,K), near the present values where H leaves it open."""
    taken = active.taken.to(active.H)
    weight = _PROXIMAL * active.H.diagonal(dim1=1, dim2=2).amax(1).clamp(min=1e-12)
    inner = active.H * taken[:, :, None] * taken[:, None, :]
    for _ in range(_TRIES):  # rounding may leave a singular H with eigenvalues below 0
        factor, failed = torch.linalg.cholesky_ex(inner + torch.diag_embed(weight[:, None] * taken + (1 - taken)))
        if not bool(failed.any()):
            break
        weight = torch.where(failed > 0, 30 * weight, weight)
    right = torch.stack([(weight[:, None] * active.value - active.f) * taken, taken], dim=2)
    free, ones = torch.cholesky_solve(right, factor).unbind(2)
    ones = ones / ones.sum(1, keepdim=True)
    aim = free + ones * (1 - free.sum(1, keepdim=True))
    for _ in range(_REPEATS - 1):
        before, right = aim, (weight[:, None] * aim - active.f) * taken
        free = torch.cholesky_solve(right[:, :, None], factor)[:, :, 0]
        aim = free + ones * (1 - free.sum(1, keepdim=True))
        if float((aim - before).abs().amax()) < _STEADY:
            break
    return aim
