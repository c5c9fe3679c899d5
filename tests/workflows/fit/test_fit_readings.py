"""Expressions that were read are counted for each photograph, or for all where all show the same."""

import torch

from torchface.capture.weight_readings import WeightReadings
from torchface.shape_names import ARKIT
from torchface.workflows.fit.fit_readings import ReadExpressions


def test_readings_of_photographs() -> None:
    read = torch.tensor([0.2, 0.6])[:, None].expand(2, 52)
    prior = ReadExpressions(None, WeightReadings.of_expression(read, torch.full((2, 52), 0.1), ARKIT))
    each = prior.energy(torch.zeros(2, 52, dtype=torch.float64))
    minimum = -torch.linalg.solve(each.H, each.f[..., None])[..., 0]
    assert torch.allclose(minimum, read.double())
    same = prior.energy(torch.zeros(1, 52, dtype=torch.float64))
    assert torch.allclose(-torch.linalg.solve(same.H, same.f[..., None])[..., 0], torch.full((1, 52), 0.4).double())
