"""Time warps that were planted are found again; the path through a sequence is the best there is."""

from __future__ import annotations

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.enhancement.conftest import Database
from torchface.enhancement import EnhancementModel
from torchface.enhancement.animation_retiming import at_moments, retimed_moments
from torchface.enhancement.timing.actor_timing import ActorTiming, LearnedTiming
from torchface.enhancement.timing.motion_keyframes import find_keyframes
from torchface.enhancement.timing.nearest_timing import motion_progress
from torchface.enhancement.timing.retiming_path import project_sequence
from torchface.errors import ShapeError, TorchfaceError, ValueRangeError


def random_points(seed: int, count: int, dimensions: int = 3) -> Tensor:
    return torch.randn(count, dimensions, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def slow_then_fast(frames: int) -> Tensor:
    return torch.linspace(0, 1, frames, dtype=torch.float64) ** 3


def motion(progress: Tensor) -> Tensor:
    """Features (n,4,9) of a face that goes straight from rest to an extreme."""
    return progress[:, None, None] * random_points(5, 36).flatten()[:36].reshape(1, 4, 9)


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(2, 5))
def test_the_path_is_the_least_of_all(seed: int, frames: int, length: int) -> None:
    alpha, beta = random_points(seed, frames), random_points(seed + 1, length)
    found = project_sequence(alpha, beta)
    steps = beta[1:] - beta[:-1]
    offset = alpha[:, None] - beta[:-1]
    share = ((offset * steps).sum(-1) / steps.square().sum(-1)).clamp(0, 1)
    cost = (offset - share[..., None] * steps).norm(dim=-1)
    paths = itertools.combinations_with_replacement(range(length - 1), frames)
    best = min(paths, key=lambda path: float(cost[range(frames), list(path)].sum()))
    taken = [min(int(time), length - 2) for time in found.times]
    alone = all(best.count(segment) == 1 for segment in best)
    assert bool((found.times[1:] >= found.times[:-1]).all())
    if alone:  # in one segment order may cost more
        assert float(found.distances.sum()) == pytest.approx(float(cost[range(frames), list(best)].sum()), abs=1e-6)
    else:
        assert float(found.distances.sum()) >= float(cost[range(frames), list(best)].sum()) - 1e-6
        assert all(abs(a - b) <= 1 for a, b in zip(taken, best, strict=True))


def test_a_planted_warp_is_found() -> None:
    beta = random_points(0, 12).cumsum(0)
    times = torch.tensor([0.0, 0.4, 0.9, 3.5, 3.5, 7.25, 10.9, 11.0], dtype=torch.float64)
    before = times.floor().long().clamp(max=10)
    alpha = torch.lerp(beta[before], beta[before + 1], (times - before)[:, None])
    found = project_sequence(alpha, beta)
    torch.testing.assert_close(found.times, times)
    assert float(found.distances.max()) < 1e-6


def test_order_is_held_inside_a_segment() -> None:
    alpha = torch.tensor([[0.2, 0.0], [0.8, 0.0], [0.4, 0.0]])
    found = project_sequence(alpha, torch.tensor([[0.0, 0.0], [1.0, 0.0]]))
    torch.testing.assert_close(found.times, torch.tensor([0.2, 0.6, 0.6], dtype=torch.float64))


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


def test_keyframes_are_kept_exactly(model: EnhancementModel, database: Database) -> None:
    keyframes = database.smooth[[0, 4]]
    times = model.retime(keyframes, 12)
    assert times.shape == (len(model.region_names), 12)
    assert bool((times[:, 1:] >= times[:, :-1]).all())
    frames = at_moments(keyframes, times.double(), model.vertex_weights)
    assert torch.equal(frames[0], keyframes[0])
    assert torch.equal(frames[-1], keyframes[1])


def test_a_captured_motion_keeps_its_own_timing(model: EnhancementModel, database: Database) -> None:
    times = model.retime(database.smooth[[0, 4]], 5)
    own = torch.linspace(0, torch.pi / 2, 5).sin()
    linear = torch.linspace(0, 1, 5)
    assert float((times - own).abs().mean()) < 0.5 * float((linear - own).abs().mean())


def test_an_animation_keeps_its_keyframes(model: EnhancementModel, database: Database) -> None:
    there = torch.linspace(0, 1, 13)[:, None, None]
    neutral, extreme = database.neutral, database.smooth[4]
    linear = neutral + torch.cat([there, torch.ones(4, 1, 1), there.flip(0)]) * (extreme - neutral)
    moments = retimed_moments(model, model.features(linear), model.fps)
    retimed = at_moments(linear, moments, model.vertex_weights)
    for frame in (0, 13, 14, 29):
        torch.testing.assert_close(retimed[frame], linear[frame], atol=1e-3, rtol=0)
    assert bool((moments[:, 1:] >= moments[:, :-1]).all())
    assert float((moments - torch.arange(30.0)).abs().max()) > 0.5  # of a sine, not linear


def test_the_turns_of_a_path_are_its_keyframes() -> None:
    out, back = torch.linspace(0, 1, 10)[:, None], torch.linspace(1, 0, 15)[:, None]
    path = torch.cat([torch.cat([out, 0 * out], 1), torch.cat([back, 1 - back], 1)])
    keys = find_keyframes(path, 0.08)
    assert keys[0] == 0
    assert keys[-1] == 24
    assert any(key in (9, 10) for key in keys)
    assert len(keys) == 3


def test_moments_between_frames_are_blends() -> None:
    frames = random_points(0, 4 * 5).reshape(4, 5, 3)
    moments = torch.tensor([[0.0, 1.5, 3.0], [0.0, 0.5, 3.0]])
    shares = torch.tensor([[1.0, 0.0, 1.0, 0.0, 0.5], [0.0, 1.0, 0.0, 1.0, 0.5]])
    found = at_moments(frames, moments, shares)
    torch.testing.assert_close(found[1, 0], (frames[1, 0] + frames[2, 0]) / 2)
    torch.testing.assert_close(found[1, 1], (frames[0, 1] + frames[1, 1]) / 2)
    torch.testing.assert_close(found[1, 4], frames[1, 4])
    torch.testing.assert_close(found[[0, 2]], frames[[0, 3]])


def test_what_has_no_motion_is_refused(model: EnhancementModel, database: Database) -> None:
    known = motion(slow_then_fast(9))
    with pytest.raises(ValueRangeError, match="equal"):
        model.retime(database.smooth[[3, 3]], 10)
    with pytest.raises(TorchfaceError, match="frames: found 1"):
        model.retime(database.smooth[[0, 4]], 1)
    with pytest.raises(ValueRangeError, match="two frames or more"):
        ActorTiming(known, torch.arange(9), torch.ones(1, 4), 30.0)
    with pytest.raises(ShapeError, match="two frames at least"):
        project_sequence(torch.zeros(3, 2), torch.zeros(1, 2))
