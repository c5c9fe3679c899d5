"""Cuts: found between two pictures, and not where somebody moves, light changes or a camera shakes."""

import itertools

import pytest
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from planted.crossing_people import crossing_film
from torchface.landmarks.images.picture_cut import cut_between, small_copy


def wall(seed: int, height: int = 120, width: int = 160) -> Tensor:
    """A coarse pattern, uint8 (H,W,3)."""
    colors = torch.rand(1, 3, 6, 8, generator=torch.Generator().manual_seed(seed))
    return (255 * interpolate(colors, size=(height, width), mode="bilinear")[0]).byte().permute(1, 2, 0)


def is_cut(before: Tensor, after: Tensor, change: float = 0.0) -> bool:
    return bool(cut_between(small_copy(before), small_copy(after), torch.tensor(change))[0])


def test_another_picture_is_a_cut_and_a_changed_one_is_none() -> None:
    first, covered = wall(0), wall(0)
    covered[30:90, 40:80] = wall(1)[30:90, 40:80]
    assert is_cut(first, wall(1))
    for other in (first, covered, (0.4 * first + 60).byte(), first.roll(3, 1)):
        assert not is_cut(first, other)


def test_where_pictures_change_all_the_time_a_cut_changes_more() -> None:
    _, change = cut_between(small_copy(wall(0)), small_copy(wall(1)), torch.tensor(0.0))
    assert not is_cut(wall(0), wall(1), float(change) / 3.9)
    assert is_cut(wall(0), wall(1), float(change) / 4.1)


def test_who_passes_close_to_a_slow_camera_is_no_cut() -> None:
    """Ten pictures a second, of a face that fills a plain picture's middle."""
    frames = crossing_film(hidden=0.2, larger=1.4).frames.permute(0, 2, 3, 1)[::3, 20:220, 110:300]
    copies, change = [small_copy(frame) for frame in frames], torch.tensor(0.0)
    largest = 0.0
    for before, after in itertools.pairwise(copies):
        cut, change = cut_between(before, after, change)
        assert not cut
        largest = max(largest, float(change))
    assert largest > 0.5


@pytest.mark.parametrize("size", [(5, 7), (64, 64), (1080, 1920)])
def test_a_small_copy_has_the_pictures_colours(size: tuple[int, int]) -> None:
    picture = wall(2, *size)
    opaque = torch.cat([picture, torch.full((*size, 1), 255, dtype=torch.uint8)], 2)
    copy = small_copy(opaque)
    torch.testing.assert_close(copy, small_copy(picture))
    torch.testing.assert_close(copy.mean((1, 2)), picture.float().mean((0, 1)), atol=4.0, rtol=0.0)
