"""A retimed animation keeps its keyframes."""

import pytest
import torch

from planted.timed_motion import motion, random_points, slow_then_fast
from tests.enhancement.conftest import Database
from torchface.enhancement import EnhancementModel
from torchface.enhancement.animation_retiming import at_moments, retimed_moments
from torchface.enhancement.timing.actor_timing import ActorTiming
from torchface.enhancement.timing.motion_keyframes import find_keyframes
from torchface.errors import TorchfaceError, ValueRangeError


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
