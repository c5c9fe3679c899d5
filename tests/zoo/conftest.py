"""Small models, and a home of their own."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, zoo
from torchface.capture import MarkerSolver
from torchface.geometry.similarity import Similarity
from torchface.modeling.morphable.morphable_model import MorphableModel

CARD = zoo.ModelCard("MIT", "nothing but noise", {"error": 0.25}, "python -m train.none")


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def morphable() -> MorphableModel:
    return MorphableModel.fit(noise(6, 30, 3))


@pytest.fixture
def solver(dome_rig: BlendshapeRig) -> MarkerSolver:
    turn = torch.linalg.qr(noise(3, 3))[0]
    alignment = Similarity(torch.tensor([0.8]), (turn * torch.linalg.det(turn))[None], torch.tensor([[1.0, 2, 3]]))
    return MarkerSolver(dome_rig, Attachment.from_vertices(dome_rig.neutral, range(0, 600, 9)), alignment)


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user's own folder of models, with one in it."""
    monkeypatch.setenv(zoo.HOME, str(tmp_path / "home"))
    zoo.save_model(morphable(), tmp_path / "home" / "mine", CARD)
    return tmp_path / "home"
