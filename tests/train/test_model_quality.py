"""The measures from the Gram matrix against models made of vertices."""

import pytest
import torch

from torchface.errors import ShapeError
from torchface.geometry.sample_batches import SamplesInMemory
from torchface.modeling import MorphableModel
from train.model_quality import model_quality


@pytest.fixture(scope="module")
def values() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    basis = torch.randn(6, 90, generator=generator) * torch.linspace(4, 1, 6)[:, None]
    shapes = torch.randn(14, 6, generator=generator) @ basis + 0.3 * torch.randn(14, 90, generator=generator)
    return (100 + shapes).reshape(14, 30, 3)


def test_leaving_one_out_is_leaving_one_out(values: torch.Tensor) -> None:
    found = model_quality(SamplesInMemory(values), [1, 3, 8])
    for column, number in enumerate((1, 3, 8)):
        errors = []
        for i in range(14):
            model = MorphableModel.fit(torch.cat([values[:i], values[i + 1 :]]), number)
            again = model(model.project(values[i : i + 1]))
            errors.append((again - values[i : i + 1]).square().sum(-1).mean().sqrt())
        assert float(found.generalisation[column]) == pytest.approx(float(torch.stack(errors).mean()), rel=1e-4)
        expected = torch.stack(errors).std() / 14**0.5
        assert float(found.generalisation_error[column]) == pytest.approx(float(expected), rel=1e-3)


def test_compactness_is_the_models(values: torch.Tensor) -> None:
    found = model_quality(SamplesInMemory(values), [1, 2, 12])
    explained = MorphableModel.fit(values).explained
    assert torch.allclose(found.compactness, explained[[0, 1, 11]], rtol=1e-5)


def test_specificity_is_the_distance_to_the_nearest_sample(values: torch.Tensor) -> None:
    found = model_quality(SamplesInMemory(values), [2, 6], 4000)
    for column, number in enumerate((2, 6)):
        model = MorphableModel.fit(values, number)
        drawn = model(model.sample(4000, torch.Generator().manual_seed(7)))
        nearest = torch.cdist(drawn.flatten(1), values.flatten(1)).amin(1).mean() / 30**0.5
        assert float(found.specificity[column]) == pytest.approx(float(nearest), rel=0.03)
    apart = torch.cdist(values.flatten(1), values.flatten(1)).fill_diagonal_(torch.inf).amin(1).mean() / 30**0.5
    assert found.nearest == pytest.approx(float(apart), rel=1e-3)


def test_too_few_samples_are_refused(values: torch.Tensor) -> None:
    with pytest.raises(ShapeError, match="found 2 samples"):
        model_quality(SamplesInMemory(values[:2]), [1])
    with pytest.raises(ShapeError, match="found 14 samples"):
        model_quality(SamplesInMemory(values), [13])
