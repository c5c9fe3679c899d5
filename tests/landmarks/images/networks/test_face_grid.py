"""Features are sampled as torch samples them, and the grid goes with the face."""

from __future__ import annotations

import math

import torch
from torch.nn.functional import grid_sample

from torchface.landmarks.images.networks.face_grid import FaceGrid, sampled_at


def test_features_are_sampled_as_torch_does() -> None:
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(3, 5, 22, 22, dtype=torch.float64, generator=generator)
    places = 220 * torch.rand(3, 40, 2, dtype=torch.float64, generator=generator) - 22  # some beyond the crop
    expected = grid_sample(features, (places[:, None] + 0.5) / 88 - 1, padding_mode="border", align_corners=False)
    torch.testing.assert_close(sampled_at(features, places, 176), expected[:, :, 0].transpose(1, 2))


def test_sampling_has_the_derivative_of_differences() -> None:
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(2, 3, 8, 8, dtype=torch.float64, generator=generator, requires_grad=True)
    places = (8 + 48 * torch.rand(2, 6, 2, dtype=torch.float64, generator=generator)).requires_grad_()
    assert torch.autograd.gradcheck(lambda one, other: sampled_at(one, other, 64), (features, places))


def test_what_turns_with_the_face_is_read_alike() -> None:
    torch.manual_seed(2)
    grid = FaceGrid((2, 2)).eval().requires_grad_(False)
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")

    def read(angle: float, size: float, stated: float | None = None) -> torch.Tensor:
        middle = torch.tensor([[[127.0, 120.0]]])
        cosine, sine = size * math.cos(angle), size * math.sin(angle)
        axes = torch.tensor([[[cosine, sine], [-sine, cosine]]])
        own = (torch.stack([4 * x + 1.5, 4 * y + 1.5], -1) - middle[0]) @ axes[0].T / size**2
        waves = torch.stack([(2 * own[..., 0]).sin(), (own[..., 0] + 2 * own[..., 1]).cos()])[None]
        turn = (stated or angle) - angle
        axes = axes @ torch.tensor([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        return grid((waves, waves), middle, axes, 256)

    straight = read(0.0, 60.0)
    torch.testing.assert_close(read(0.6, 50.0), straight, rtol=0, atol=0.1 * float(straight.std()))
    assert float((read(0.6, 50.0, stated=0.3) - straight).abs().max()) > float(straight.std())
