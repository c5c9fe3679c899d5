"""A rig and a model of heads, which tests of one folder share."""

import pytest
import torch

from torchface.modeling import HeadModel, MorphableModel
from torchface.rig import BlendshapeRig
from torchface.synthetic import draw_identities, performer
from torchface.synthetic.head.identity import anatomy


@pytest.fixture(scope="package")
def rig() -> BlendshapeRig:
    return performer(texture=False)


@pytest.fixture(scope="package")
def model(rig: BlendshapeRig) -> HeadModel:
    heads = torch.stack([anatomy(who).vertices for who in draw_identities(60, torch.Generator().manual_seed(0))])
    return HeadModel.on(rig.neutral, MorphableModel.fit(heads.float(), 15))
