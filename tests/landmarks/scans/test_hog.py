"""Dense HOG and its convolution against a plain computation at single places."""

import math

import pytest
import torch

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.scans.hog import HogLayout, cell_map, similarity, unit_windows, windows

LAYOUT = HogLayout(window=32, cell=8, bins=9, stride=2)


def noise(size: int = 96, seed: int = 0) -> torch.Tensor:
    image = torch.rand(1, 1, size // 4, size // 4, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(image, size=(size, size), mode="bicubic").clamp(0, 1)


def test_edges_vote_for_their_orientation() -> None:
    x, y = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="xy")
    for k in range(9):
        angle = math.pi * k / 9
        image = 0.5 + 0.3 * torch.sin((x * math.cos(angle) + y * math.sin(angle)) * 0.5)
        cells = cell_map(image[None, None], LAYOUT)[0, :, 16, 16]
        assert int(cells.argmax()) == k


def test_cells_ignore_brightness_and_contrast() -> None:
    image = noise()
    dim = 0.2 + 0.5 * image
    assert (cell_map(image, LAYOUT) - cell_map(dim, LAYOUT)).abs().max() < 0.05


def test_convolution_is_the_cosine_of_the_windows() -> None:
    cells = cell_map(noise(), LAYOUT) - 0.2
    filters = torch.randn(5, 9, 4, 4, generator=torch.Generator().manual_seed(1))
    scores = similarity(unit_windows(cells, LAYOUT), filters)[0].view(5, *cells.shape[2:])
    places = torch.tensor([[20, 15], [24, 30], [33, 12]])
    described = windows(cells[0], LAYOUT, places).flatten(1)
    expected = torch.nn.functional.cosine_similarity(filters.flatten(1)[:, None], described[None], dim=-1)
    assert torch.allclose(scores[:, places[:, 1], places[:, 0]], expected, atol=1e-5)


def test_a_window_is_found_where_it_was_cut_out() -> None:
    image = noise(128)
    cells = cell_map(image, LAYOUT)
    at = torch.tensor([[62.0, 50.0]])
    place = LAYOUT.rows(at)
    scores = similarity(unit_windows(cells, LAYOUT), windows(cells[0], LAYOUT, place)).view(cells.shape[2:])
    best = int(scores.argmax())
    found = LAYOUT.positions(torch.tensor([best % scores.shape[1], best // scores.shape[1]]))
    assert float(scores.max()) == pytest.approx(1.0, abs=1e-5)
    assert (found - at[0]).abs().max() <= 1.0


def test_moving_the_image_moves_the_cells() -> None:
    image = noise(96)
    moved = torch.roll(image, (8, 12), (2, 3))
    first, second = cell_map(image, LAYOUT), cell_map(moved, LAYOUT)
    assert torch.allclose(first[..., 10:30, 10:30], second[..., 14:34, 16:36], atol=1e-5)


def test_layouts_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueRangeError, match="even number of cells"):
        HogLayout(window=24, cell=8)
    with pytest.raises(ValueRangeError, match="even number of strides"):
        HogLayout(window=32, cell=8, stride=3)
    with pytest.raises(ShapeError, match=r"\(B,C,H,W\)"):
        cell_map(torch.zeros(3, 8, 8), LAYOUT)
