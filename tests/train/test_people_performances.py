"""Weights of people made by code have the structure of people's, not chance's."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import load_take, zoo
from torchface.capture.priors import ShapePrior
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic.stages import perform
from train.people_performances import EPISODES, SHAPES, converse


@pytest.fixture(scope="module")
def weights() -> Tensor:
    tracks = [converse(900, torch.Generator().manual_seed(seed), 30.0).weights for seed in range(12)]
    return torch.cat([track.values[..., 0] for track in tracks if track is not None])


def column(weights: Tensor, name: str) -> Tensor:
    return weights[:, ARKIT.index(name)]


def correlation(weights: Tensor, one: str, other: str) -> float:
    return float(torch.corrcoef(torch.stack([column(weights, one), column(weights, other)]))[0, 1])


def test_antagonists_are_never_on_together(weights: Tensor) -> None:
    for one, other in (("mouthLeft", "mouthRight"), ("jawLeft", "jawRight"), ("eyeLookInLeft", "eyeLookOutLeft"),
            ("eyeLookUpRight", "eyeLookDownRight")):  # fmt: skip
        both = torch.minimum(column(weights, one), column(weights, other))
        assert float(both.max()) == 0, (one, other)
    assert float((column(weights, "mouthClose") - column(weights, "jawOpen")).max()) <= 0


@pytest.mark.parametrize("name", ["mouthSmile", "mouthFrown", "browDown", "eyeBlink", "cheekSquint", "mouthUpperUp"])
def test_both_sides_move_alike(weights: Tensor, name: str) -> None:
    assert correlation(weights, f"{name}Left", f"{name}Right") > 0.95


def test_cheeks_rise_with_smiles_and_lids_follow_gaze(weights: Tensor) -> None:
    assert correlation(weights, "mouthSmileLeft", "cheekSquintLeft") > 0.6
    assert correlation(weights, "mouthSmileLeft", "cheekSquintLeft") > correlation(
        weights, "mouthSmileLeft", "noseSneerLeft"
    )
    assert correlation(weights, "mouthSmileLeft", "mouthFrownLeft") < 0
    assert correlation(weights, "eyeLookDownLeft", "eyeBlinkLeft") > 0.6
    assert correlation(weights, "eyeLookUpLeft", "eyeBlinkLeft") < 0


def test_shapes_and_units_of_the_tables_exist() -> None:
    for parts in SHAPES.values():
        assert all(name in ARKIT or f"{name}Left" in ARKIT for name in parts)
    for _, units in EPISODES.values():
        assert set(units) <= set(SHAPES)


def test_a_take_is_its_seed(weights: Tensor) -> None:
    again = converse(900, torch.Generator().manual_seed(0), 30.0).weights
    assert torch.equal(again.values[..., 0], weights[:900])
    assert float(weights.min()) >= 0
    assert float(weights.max()) <= 1


@pytest.mark.real
def test_real_takes_are_likelier_than_under_a_prior_of_gestures(performances: list[Path]) -> None:
    prior = zoo.get_model("shape_prior").double()
    gestures = [perform(1200, torch.Generator().manual_seed(seed)).weights for seed in range(6)]
    matrix = mapping(ARKIT, prior.names).double()
    of_gestures = ShapePrior.fit(
        [g.values[..., 0].double() @ matrix.T for g in gestures if g is not None], prior.names
    ).double()
    for path in performances:
        track = load_take(path).weights
        real = (track.values[..., 0].double() @ mapping(track.names, prior.names).double().T).clamp(0, 1)
        assert float(prior.log_density(real).mean() - of_gestures.log_density(real).mean()) > 30, path.name
