"""Mean shift against scikit-learn's, and with weights."""

import numpy as np
import pytest
import torch
from sklearn.cluster import MeanShift

from torchface.errors import ShapeError, ValueRangeError
from torchface.optim.mean_shift import mean_shift


def blobs(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    centres = torch.tensor([[20.0, 30.0], [80.0, 75.0], [140.0, 20.0]])
    counts = (120, 60, 25)
    return torch.cat(
        [c + 3.5 * torch.randn(n, 2, generator=generator) for c, n in zip(centres, counts, strict=True)]
        + [160 * torch.rand(12, 2, generator=generator)]
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_agrees_with_scikit_learn(seed: int) -> None:
    points = blobs(seed)
    ours = mean_shift(points, 10.0)
    theirs = MeanShift(bandwidth=10.0, bin_seeding=True).fit(points.numpy())
    for centre, size in zip(ours.centres[:3], ours.sizes[:3], strict=True):
        away = np.linalg.norm(theirs.cluster_centers_ - centre.numpy(), axis=1)
        assert away.min() < 0.5
        assert abs(int((theirs.labels_ == away.argmin()).sum()) - int(size)) <= 2


def test_a_weight_is_a_repetition() -> None:
    points = blobs(3)
    repeats = torch.arange(len(points)) % 3 + 1
    weighted = mean_shift(points, 10.0, repeats)
    repeated = mean_shift(points.repeat_interleave(repeats, 0), 10.0)
    assert torch.allclose(weighted.centres, repeated.centres, atol=1e-4)
    assert torch.allclose(weighted.sizes, repeated.sizes)


def test_labels_name_the_nearest_centre() -> None:
    points = blobs(4)
    found = mean_shift(points, 10.0)
    assert torch.equal(found.labels, torch.cdist(points, found.centres).argmin(1))
    assert torch.equal(found.sizes, found.labels.bincount(minlength=len(found.sizes)).float())
    assert (found.sizes[:-1] >= found.sizes[1:]).all()


def test_no_point_is_refused() -> None:
    with pytest.raises(ShapeError, match="at least one"):
        mean_shift(torch.zeros(0, 2), 10.0)


@pytest.mark.parametrize("bandwidth", [0.0, -1.0, float("nan"), float("inf")])
def test_a_bandwidth_that_is_no_length_is_refused(bandwidth: float) -> None:
    with pytest.raises(ValueRangeError, match="bandwidth: found"):
        mean_shift(blobs(0), bandwidth)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_points_and_weights_are_numbers(bad: float) -> None:
    points = blobs(0)
    with pytest.raises(ValueRangeError, match="weights hold"):
        mean_shift(points, 10.0, torch.full((len(points),), bad))
    points[3, 1] = bad
    with pytest.raises(ValueRangeError, match="points hold"):
        mean_shift(points, 10.0)
