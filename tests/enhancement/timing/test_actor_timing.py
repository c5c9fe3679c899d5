"""Timing that was planted is learned, and never runs backwards."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from planted.timed_motion import motion, random_points, slow_then_fast
from torchface.enhancement.timing.actor_timing import ActorTiming, LearnedTiming
from torchface.enhancement.timing.nearest_timing import motion_progress


@pytest.mark.parametrize("falls", [False, True])
def test_the_neutral_at_both_ends_is_told_apart_by_direction(falls: bool) -> None:
    rise = slow_then_fast(20)
    database = motion(torch.cat([rise, rise[:-1].flip(0) ** 0.2]))
    pair = motion(torch.tensor([0.0, 0.6], dtype=torch.float64))
    timing = ActorTiming(database, torch.zeros(39), torch.ones(2, 4), 30.0)
    times = timing.times(pair.flip(0) if falls else pair, 31, 12.0)
    known = torch.cat([rise[:1], 1 - rise[:-1].flip(0) ** 0.2]) if falls else rise
    asked = torch.linspace(0, len(known) - 1, 31, dtype=torch.float64)
    low = asked.floor().long().clamp(max=len(known) - 2)
    expected = torch.lerp(known[low], known[low + 1], asked - low)
    assert float((times[0] - expected).abs().max()) < 0.06
    assert bool((times[:, 1:] >= times[:, :-1]).all())
    assert times[:, 0].tolist() == [0, 0]
    assert times[:, -1].tolist() == [1, 1]


@pytest.mark.parametrize("extend", [False, True])
def test_a_part_of_a_motion_is_timed_as_that_part_or_extended_to_the_whole(extend: bool) -> None:
    """A captured smile eases in and out; half a smile meets its first half, which eases in alone."""
    even = torch.linspace(0, 1, 41, dtype=torch.float64)
    smile = 3 * even**2 - 2 * even**3
    timing = ActorTiming(motion(smile), torch.zeros(41), torch.ones(1, 4), 30.0)
    times = timing.times(motion(smile[[0, 20]]), 41, 40.0, extend)[0]
    half = (3 * (even / 2) ** 2 - 2 * (even / 2) ** 3) / 0.5
    assert float((times - (smile if extend else half)).abs().max()) < 0.05  # the slow ends count as held
    assert float((smile - half).abs().max()) > 0.15


def test_a_hold_inside_a_motion_keeps_its_share_of_time() -> None:
    progress = torch.cat([torch.linspace(0, 0.5, 11), torch.full((20,), 0.5), torch.linspace(0.5, 1, 11)]).double()
    found = motion_progress(motion(progress).flatten(1), 42)
    assert float((found - progress).abs().max()) < 0.02


def course(even: Tensor, length: float) -> Tensor:
    """How far a planted motion has come: the longer it lasts, the more it gathers speed."""
    late = length / 100
    return (1 - late) * even + late * even**2


def planted_motions(count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Motions to extremes, each followed by a hold: features (K,4,9) and the number of each frame's sequence, (K,)."""
    generator = torch.Generator().manual_seed(seed)
    lengths = torch.randint(20, 80, (count,), generator=generator)
    sizes = 0.5 + torch.rand(count, generator=generator, dtype=torch.float64)
    found, numbers = [], []
    for number, (length, size) in enumerate(zip(lengths.tolist(), sizes.tolist(), strict=True)):
        progress = course(torch.linspace(0, 1, length + 1, dtype=torch.float64), length)
        found.append(torch.cat([motion(size * progress), motion(torch.full((5,), size, dtype=torch.float64))]))
        numbers.append(torch.full((length + 6,), number))
    return torch.cat(found), torch.cat(numbers)


def test_how_a_motions_course_follows_from_its_length_is_learned() -> None:
    database, sequences = planted_motions(40, 1)
    timing = ActorTiming(database, sequences, torch.ones(1, 4), 10.0)
    pair = motion(torch.tensor([0.0, 0.9], dtype=torch.float64))
    even = torch.linspace(0, 1, 25, dtype=torch.float64)
    for length, other in ((25.0, 75.0), (75.0, 25.0)):
        found = timing.times(pair, 25, length)[0]
        assert float((found - course(even, length)).abs().max()) < 0.06
        assert float((found - course(even, other)).abs().max()) > 0.06
        assert bool((found.diff() >= 0).all())


def test_a_region_of_few_motions_learns_none() -> None:
    database, sequences = planted_motions(11, 2)
    assert LearnedTiming.fit(database, sequences, torch.ones(4), 30.0) is None
    database, sequences = planted_motions(12, 2)
    assert LearnedTiming.fit(database, sequences, torch.ones(4), 30.0) is not None


def test_timing_goes_by_seconds_not_by_frames() -> None:
    database, sequences = planted_motions(40, 3)
    timing = ActorTiming(database, sequences, torch.ones(1, 4), 30.0)
    pair = motion(torch.tensor([0.0, 1.0], dtype=torch.float64))
    sparse, dense = timing.times(pair, 21, 20.0), timing.times(pair, 41, 20.0)
    torch.testing.assert_close(dense[:, ::2], sparse)


@pytest.fixture(scope="module")
def known_timing() -> ActorTiming:
    return ActorTiming(*planted_motions(16, 4), torch.tensor([[1.0, 1.0, 0, 0], [0, 0.5, 1.0, 1.0]]), 30.0)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 90), st.floats(0.1, 1000), st.integers(-3, 3))
def test_time_never_runs_backwards(known_timing: ActorTiming, seed: int, frames: int, length: float, size: int) -> None:
    pair = random_points(seed, 8, 9).reshape(2, 4, 9) * 10.0**size
    times = known_timing.times(pair.float(), frames, length)
    assert times.shape == (2, frames)
    assert bool((times[:, 1:] >= times[:, :-1]).all())
    assert times[:, 0].tolist() == [0, 0]
    assert times[:, -1].tolist() == [1, 1]
