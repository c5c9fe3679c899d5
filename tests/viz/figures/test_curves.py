"""Curves of weights over time."""

import warnings

import torch

from torchface.viz.figures.curves import weight_curves


def test_a_film_of_one_frame_is_drawn_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        picture = weight_curves(torch.rand(1, 2), None, ["jawOpen", "mouthPucker"], fps=30.0)
    assert picture.max() == 1
