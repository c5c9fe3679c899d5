"""Shapes that were moved come back onto their mean, from memory and in blocks."""

import pytest
import torch
from scipy.spatial import procrustes
from scipy.spatial.transform import Rotation

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry import sample_batches as module
from torchface.geometry.sample_batches import SamplesInMemory, blocks
from train.generalised_procrustes import aligned, generalised_procrustes
from train.sample_views import SampleRange


@pytest.fixture(scope="module")
def shapes() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    mean = 60 * torch.randn(50, 3, generator=generator, dtype=torch.float64)
    return mean + 2 * torch.randn(11, 50, 3, generator=generator, dtype=torch.float64)


def moved(shapes: torch.Tensor, scale: bool = False) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    turns = torch.from_numpy(Rotation.random(len(shapes), rng=3).as_matrix())
    sizes = torch.exp(0.2 * torch.randn(len(shapes), 1, 1, generator=generator)) if scale else 1.0
    return sizes * shapes @ turns.mT + 100 * torch.randn(len(shapes), 1, 3, generator=generator)


def spread(shapes: torch.Tensor) -> float:
    return float((shapes - shapes.mean(0)).square().sum(-1).mean())


def test_motions_are_taken_back(shapes: torch.Tensor) -> None:
    apart = SamplesInMemory(moved(shapes))
    found = generalised_procrustes(apart)
    laid = aligned(apart, found).read(0, 11)
    assert spread(laid) <= spread(shapes)
    assert (laid.mean(0) - found.mean).norm(dim=1).mean() < 1e-2
    assert torch.allclose(torch.pdist(laid[4]), torch.pdist(shapes[4]))  # no size is changed
    # Each shape lies on the mean as well as it can.
    for shape in laid:
        again = procrustes(found.mean.numpy(), shape.numpy())[2]
        centred = [x - x.mean(0) for x in (shape, found.mean)]
        norms = [x.norm() for x in centred]
        cosine = (centred[0] * centred[1]).sum() / norms[0] / norms[1]
        assert float(cosine) ** 2 == pytest.approx(1 - again, abs=1e-6)


def test_the_mean_lies_where_it_is_asked_to(shapes: torch.Tensor) -> None:
    apart = SamplesInMemory(moved(shapes))
    start = shapes.mean(0)
    found = generalised_procrustes(apart, initial_mean=start)
    assert (found.mean - start).norm(dim=1).mean() < 0.5
    assert spread(aligned(apart, found).read(0, 11)) <= spread(shapes)


def test_sizes_are_taken_off_and_their_mean_stays(shapes: torch.Tensor) -> None:
    apart = moved(shapes, scale=True)
    found = generalised_procrustes(SamplesInMemory(apart), scale=True)
    laid = aligned(SamplesInMemory(apart), found).read(0, 11)
    sizes = [(x - x.mean(1, keepdim=True)).square().sum((1, 2)).sqrt() for x in (apart, laid)]
    assert sizes[1].std() / sizes[1].mean() < 0.02 < sizes[0].std() / sizes[0].mean()
    assert float(sizes[1].mean()) == pytest.approx(float(sizes[0].mean()), rel=0.01)


def test_blocks_change_nothing(shapes: torch.Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    apart = SamplesInMemory(moved(shapes))
    whole = generalised_procrustes(apart)
    assert list(blocks(apart, 8 * 150 * 4)) == [(0, 4), (4, 8), (8, 11)]
    monkeypatch.setattr(module.blocks, "__defaults__", (8 * 150 * 4,))
    pieces = generalised_procrustes(apart)
    assert torch.allclose(pieces.mean, whole.mean)
    assert torch.allclose(pieces.poses.rotation, whole.poses.rotation)
    part = SampleRange(aligned(apart, whole), 3, 9)
    assert part.shape == (6, 50, 3)
    assert torch.equal(part.read(1, 3), aligned(apart, whole).read(4, 6))


def test_what_cannot_be_laid_is_refused(shapes: torch.Tensor) -> None:
    with pytest.raises(ShapeError, match=r"expected \(M,V,3\)"):
        generalised_procrustes(SamplesInMemory(shapes[..., :2]))
    with pytest.raises(ShapeError, match="initial_mean"):
        generalised_procrustes(SamplesInMemory(shapes), initial_mean=shapes[0, :5])
    broken = shapes.clone()
    broken[6, 0, 0] = float("inf")
    with pytest.raises(ValueRangeError, match="number 6"):
        generalised_procrustes(SamplesInMemory(broken))
