"""Made-up performances move like faces: smooth, within range, symmetric where faces are."""

import torch

from torchface.shape_names import ARKIT
from torchface.synthetic.stages.weight_curves import perform


def test_weights_are_in_range_smooth_and_rich() -> None:
    take = perform(1800, torch.Generator().manual_seed(0))
    weights = take.weights.values[..., 0]
    assert weights.min() >= 0
    assert weights.max() <= 1
    assert weights.diff(dim=0).abs().max() < 0.45  # a blink closes in 80 ms, five frames
    used = weights.amax(0) > 0.2
    assert used.sum() >= 45
    assert not used[ARKIT.index("tongueOut")]


def test_eyes_look_the_same_way() -> None:
    take = perform(1200, torch.Generator().manual_seed(1))
    look = {name: take.weights.values[:, i, 0] for i, name in enumerate(ARKIT)}
    left = look["eyeLookOutLeft"] - look["eyeLookInLeft"]
    right = look["eyeLookOutRight"] - look["eyeLookInRight"]
    torch.testing.assert_close(left, -right)


def test_seed_decides_the_take() -> None:
    first, again, other = (perform(300, torch.Generator().manual_seed(seed)) for seed in (5, 5, 6))
    assert torch.equal(first.weights.values, again.weights.values)
    assert not torch.equal(first.weights.values, other.weights.values)
