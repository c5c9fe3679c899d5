"""Blur and unsharp mask against SciPy's, on images of every size that kornia treats in its own way."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from torchface.rendering.gaussian_blur import gaussian_blur, unsharp


@pytest.mark.parametrize(("height", "width"), [(40, 30), (300, 300)])
@pytest.mark.parametrize("truncate", [2.5, 3.0])
def test_blur_agrees_with_scipy(height: int, width: int, truncate: float) -> None:
    image = torch.rand(2, 3, height, width, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = gaussian_filter(image.numpy(), (0, 0, 2.0, 2.0), mode="nearest", truncate=truncate)
    assert np.abs(gaussian_blur(image, 2.0, truncate).numpy() - expected).max() < 1e-9


def test_no_blur_leaves_the_image() -> None:
    image = torch.rand(1, 1, 5, 4)
    assert torch.equal(gaussian_blur(image, 0), image)


def test_unsharp_raises_an_edge_and_leaves_flat_parts() -> None:
    image = torch.zeros(1, 1, 20, 60)
    image[..., 30:] = 1.0
    sharp = unsharp(image, 2.0, 1.0)
    assert sharp.max() > 1.3
    assert torch.allclose(sharp[..., :15], image[..., :15], atol=1e-5)
