"""Smooth differences have the covariance that is said of them, and are alike on both sides."""

import torch

from torchface.modeling.photographs.smooth_differences import smooth_differences
from torchface.synthetic import neutral_head


def test_their_variance_is_that_of_a_process_made_symmetric() -> None:
    head = neutral_head(texture=False)
    marks = head.landmarks
    x = head.vertices[marks].double()
    modes = smooth_differences(head.vertices, marks, 2.0)[:, marks].double()
    covariance = torch.einsum("mla,mka->alk", modes, modes)
    mirrored = x * x.new_tensor([-1.0, 1.0, 1.0])
    near, across = (torch.exp(-torch.cdist(x, y).square() / (2 * 20.0**2)) for y in (x, mirrored))
    for axis, sign in enumerate((-1.0, 1.0, 1.0)):
        expected = 2.0 * (near + sign * 0.5 * (across + across.T))  # 2², halved
        assert float((covariance[axis] - expected).abs().max()) < 0.15


def test_both_sides_move_alike() -> None:
    head = neutral_head(texture=False)
    assert head.annotations is not None
    twin = head.annotations.mirror
    assert twin is not None
    modes = smooth_differences(head.vertices, head.landmarks, 1.0)
    flipped = modes[:, twin] * torch.tensor([-1.0, 1.0, 1.0])
    assert float((modes - flipped).abs().max()) < 0.02


def test_none_are_expected() -> None:
    head = neutral_head(texture=False)
    assert smooth_differences(head.vertices, head.landmarks, 0.0).shape == (0, len(head.vertices), 3)
