"""Examples of the embedded performer, and somebody else's landmarks made of them."""

import pytest
import torch
from torch import Tensor

from torchface.capture.anybody import ExampleShapes, paper_examples
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer


@pytest.fixture(scope="session")
def performer_rig() -> BlendshapeRig:
    return performer(texture=False)


@pytest.fixture(scope="session")
def examples(performer_rig: BlendshapeRig) -> ExampleShapes:
    """The paper's 15."""
    return paper_examples(performer_rig)


@pytest.fixture(scope="session")
def planted() -> Tensor:
    """Weights of the 15 in 12 frames, about a third of them active, (12,15) float64."""
    generator = torch.Generator().manual_seed(0)
    shape = (12, 15)
    active = torch.rand(shape, generator=generator) < 0.35
    return (torch.rand(shape, generator=generator) * active).double()
