"""Keys instead of samples: within the bound at every sample, few, and where NaN is, all."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchface.errors import ShapeError, ValueRangeError
from torchface.temporal.key_reduction import kept_keys, reduction_error


def fewest(times: np.ndarray, values: np.ndarray, bound: float) -> int:
    """The least number of keys, by dynamic programming over all segments that fit (Imai and Iri)."""
    count = len(times)
    least = [0] + [count] * (count - 1)
    for j in range(1, count):
        for i in range(j):
            share = (times[i : j + 1] - times[i]) / (times[j] - times[i])
            line = values[i] + share[:, None] * (values[j] - values[i])
            if np.abs(line - values[i : j + 1]).max() <= bound:
                least[j] = min(least[j], least[i] + 1)
    return least[-1] + 1


def split(times: np.ndarray, values: np.ndarray, bound: float) -> int:
    """How many keys Ramer, Douglas and Peucker's halving needs beside the first."""
    share = (times - times[0]) / (times[-1] - times[0])
    far = np.abs(values[0] + share[:, None] * (values[-1] - values[0]) - values).max(1)
    worst = int(far.argmax())
    if far[worst] <= bound:
        return 1
    return split(times[: worst + 1], values[: worst + 1], bound) + split(times[worst:], values[worst:], bound)


def walk(seed: int, curves: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    times = torch.rand(40, generator=generator).double().add(0.01).cumsum(0)
    return times, (0.2 * torch.randn(40, curves, generator=generator)).cumsum(0).double()


@given(seed=st.integers(0, 10**6), curves=st.integers(1, 3), bound=st.sampled_from([1e-3, 0.05, 0.3]))
def test_the_bound_is_kept_at_every_sample(seed: int, curves: int, bound: float) -> None:
    times, values = walk(seed, curves)
    kept = kept_keys(times, values, bound)
    assert kept[0]
    assert kept[-1]
    assert reduction_error(times, values, kept) <= bound
    assert int(kept.sum()) >= fewest(times.numpy(), values.numpy(), bound)


@pytest.mark.parametrize("bound", [0.1, 0.3])
def test_keys_are_nearly_the_fewest_and_fewer_than_by_halving(bound: float) -> None:
    counts = []
    for seed in range(40):
        times, values = walk(seed, 1 + seed % 3)
        given = times.numpy(), values.numpy(), bound
        counts.append((int(kept_keys(times, values, bound).sum()), fewest(*given), split(*given) + 1))
    ours, least, halved = np.sum(counts, 0)
    assert ours < 1.1 * least
    assert ours < halved


def test_long_straight_parts_need_two_keys_and_a_take_a_fraction() -> None:
    times = torch.arange(5000) / 60
    straight = torch.stack([0.2 * times, torch.ones(5000)], 1)
    assert kept_keys(times, straight, 1e-3).nonzero()[:, 0].tolist() == [0, 4999]
    smooth = torch.stack([torch.sin(times), torch.cos(0.7 * times)], 1)
    kept = kept_keys(times, smooth, 1e-3)
    assert reduction_error(times, smooth, kept) <= 1e-3
    assert int(kept.sum()) < 0.2 * 5000


def test_samples_beside_a_nan_stay() -> None:
    values = torch.zeros(20, 2)
    values[7, 1] = torch.nan
    kept = kept_keys(torch.arange(20), values, 0.1)
    assert kept.nonzero()[:, 0].tolist() == [0, 6, 7, 8, 19]
    assert kept_keys(torch.arange(1), torch.zeros(1, 1), 0.1).tolist() == [True]
    assert kept_keys(torch.arange(0), torch.zeros(0, 1), 0.1).tolist() == []


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueRangeError, match="bound of keys: found 0"):
        kept_keys(torch.arange(3), torch.zeros(3, 1), 0.0)
    with pytest.raises(ShapeError, match=r"found times \(3,\) and values \(4, 1\)"):
        kept_keys(torch.arange(3), torch.zeros(4, 1), 0.1)
