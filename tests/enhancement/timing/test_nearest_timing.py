"""A captured motion is read without jumps, and only by what it shares with the keyframes."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from planted.timed_motion import motion, random_points
from torchface.enhancement.timing.nearest_timing import motion_progress, nearest_timing

EASED = torch.linspace(0, torch.pi / 2, 13, dtype=torch.float64).sin().square()


def there_and_back(direction: Tensor) -> Tensor:
    """A sequence (25,4,9) from the neutral to an extreme and back."""
    way = torch.cat([EASED, EASED[:-1].flip(0)])
    return way[:, None, None] * direction


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 20))
def test_no_step_is_larger_than_the_captured_one(seed: int, frames: int) -> None:
    path = random_points(seed, frames, 3).cumsum(0)
    found = motion_progress(path, frames)
    way = path[-1] - path[0]
    captured = ((path[1:] - path[:-1]) @ way / way.square().sum()).clamp(min=0)
    assert bool((found.diff() >= 0).all())
    assert bool((found.diff() <= captured.max() + 1e-9).all())
    assert found[[0, -1]].tolist() == [0, 1]


@pytest.mark.parametrize("extend", [False, True])
def test_the_actors_own_motion_comes_back_exactly(extend: bool) -> None:
    own, other = motion(EASED), there_and_back(random_points(1, 4, 9).reshape(4, 9))
    bent = own + torch.sin(torch.pi * EASED)[:, None, None] * 0.2 * random_points(2, 4, 9).reshape(4, 9)
    times = nearest_timing(bent[[0, -1]], [other, bent], torch.ones(4), 13, 12.0, extend=extend)
    way = own[-1] - own[0]
    along = ((bent - bent[0]) * way).sum((1, 2)) / way.square().sum()
    torch.testing.assert_close(times, along, atol=1e-5, rtol=0)


@pytest.mark.parametrize("extend", [False, True])
def test_a_sequence_that_the_keyframes_meet_at_its_neutrals_adds_no_jump(extend: bool) -> None:
    """A smile with what was never captured: another motion's neutrals, first and last, lie nearest to both."""
    smile, jaw, brows = random_points(3, 12, 9).reshape(3, 4, 9)
    keyframes = torch.stack([0 * smile, smile - 0.6 * jaw])
    captured = [there_and_back(direction) for direction in (smile, jaw, brows, jaw + brows)]
    times = nearest_timing(keyframes, captured, torch.ones(4), 13, 12.0, extend=extend)
    assert float(times.diff().max()) < 1.1 * float(EASED.diff().max())
    assert float(times.diff()[[0, -1]].max()) < 2 * float(EASED.diff()[0])


@pytest.mark.parametrize("extend", [False, True])
@pytest.mark.parametrize("held", [1, 2, 5])
def test_poses_that_both_lie_at_a_sequences_rest_find_no_motion_there(extend: bool, held: int) -> None:
    """Frames that are equal in every digit lie at one place of the way: of them the later pose may meet an earlier."""
    smile = random_points(4, 4, 9).reshape(4, 9)
    keyframes = torch.stack([0 * smile, -smile])
    captured = torch.cat([torch.zeros(held, 4, 9, dtype=torch.float64), EASED[1:, None, None] * smile])
    times = nearest_timing(keyframes, [captured], torch.ones(4), 13, 12.0, extend=extend)
    torch.testing.assert_close(times, torch.linspace(0, 1, 13).to(times), atol=1e-6, rtol=0)
