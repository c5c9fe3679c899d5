"""The path through a sequence is the best there is."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchface.enhancement.timing.nearest_timing import project_sequence


def random_points(seed: int, count: int, dimensions: int = 3) -> Tensor:
    return torch.randn(count, dimensions, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(2, 5))
def test_the_path_is_the_least_of_all(seed: int, frames: int, length: int) -> None:
    alpha, beta = random_points(seed, frames), random_points(seed + 1, length)
    found = project_sequence(alpha, beta)
    steps = beta[1:] - beta[:-1]
    offset = alpha[:, None] - beta[:-1]
    share = ((offset * steps).sum(-1) / steps.square().sum(-1)).clamp(0, 1)
    cost = (offset - share[..., None] * steps).norm(dim=-1)
    paths = itertools.combinations_with_replacement(range(length - 1), frames)
    best = min(paths, key=lambda path: float(cost[range(frames), list(path)].sum()))
    taken = [min(int(time), length - 2) for time in found.times]
    alone = all(best.count(segment) == 1 for segment in best)
    assert bool((found.times[1:] >= found.times[:-1]).all())
    if alone:  # in one segment order may cost more
        assert float(found.distances.sum()) == pytest.approx(float(cost[range(frames), list(best)].sum()), abs=1e-6)
    else:
        assert float(found.distances.sum()) >= float(cost[range(frames), list(best)].sum()) - 1e-6
        assert all(abs(a - b) <= 1 for a, b in zip(taken, best, strict=True))


def test_a_planted_warp_is_found() -> None:
    beta = random_points(0, 12).cumsum(0)
    times = torch.tensor([0.0, 0.4, 0.9, 3.5, 3.5, 7.25, 10.9, 11.0], dtype=torch.float64)
    before = times.floor().long().clamp(max=10)
    alpha = torch.lerp(beta[before], beta[before + 1], (times - before)[:, None])
    found = project_sequence(alpha, beta)
    torch.testing.assert_close(found.times, times)
    assert float(found.distances.max()) < 1e-6


def test_order_is_held_inside_a_segment() -> None:
    alpha = torch.tensor([[0.2, 0.0], [0.8, 0.0], [0.4, 0.0]])
    found = project_sequence(alpha, torch.tensor([[0.0, 0.0], [1.0, 0.0]]))
    torch.testing.assert_close(found.times, torch.tensor([0.2, 0.6, 0.6], dtype=torch.float64))
