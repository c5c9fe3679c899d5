"""Tests of others' identity parameters as principal components."""

import pytest
import torch

from torchface import Mesh
from torchface.errors import FileFormatError
from torchface.io.head_models.head_model_file import HeadModelFile
from torchface.modeling.morphable.published_models import head_model_of


def file(ways: torch.Tensor) -> HeadModelFile:
    mean = Mesh(torch.randn(30, 3, generator=torch.Generator().manual_seed(0)), torch.tensor([[0, 1, 2], [2, 3, 4]]))
    return HeadModelFile("planted", mean, ways, ways[:0], ())


def test_the_components_have_the_covariance_of_the_published_ways() -> None:
    """Ways that are not orthogonal, one of them the sum of two others: the same Gaussian by four components."""
    ways = torch.randn(4, 30, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    ways = torch.cat([ways, (ways[0] + ways[1])[None]]).float()
    model = head_model_of(file(ways))
    assert model.shape.count == 4
    modes, own = model.shape.modes.flatten(1).double(), ways.flatten(1).double()
    assert torch.allclose(modes.T @ modes, own.T @ own, atol=1e-4)
    assert torch.allclose(
        model.shape.components.flatten(1) @ model.shape.components.flatten(1).T, torch.eye(4), atol=1e-5
    )
    assert head_model_of(file(ways), components=2).shape.count == 2


def test_a_model_without_ways_is_refused() -> None:
    for ways in (torch.zeros(0, 30, 3), torch.zeros(3, 30, 3)):
        with pytest.raises(FileFormatError, match="no identity parameters"):
            head_model_of(file(ways))
