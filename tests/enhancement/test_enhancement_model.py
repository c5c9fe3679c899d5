"""What holds of an actor's model: its own frames come back, motion goes along, bad input is told."""

from __future__ import annotations

import copy
import math

import pytest
import torch

from torchface.enhancement import EnhancementModel
from torchface.errors import AlignmentError, TopologyError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.zoo import get_model, save_model


def test_a_rigid_motion_of_the_input_moves_the_output_alike(model, database):
    turn, shift = rotation_matrix(torch.tensor([0.3, 0.6, -0.2])), torch.tensor([200.0, -50.0, 400.0])
    still = model(database.smooth[3:6])
    moved = model(database.smooth[3:6] @ turn.T + shift)
    assert torch.allclose(moved, still @ turn.T + shift, atol=1e-3)


def test_the_neutral_gives_the_neutral(model, database):
    assert float((model(database.neutral[None]) - database.neutral).norm(dim=-1).max()) < 0.01


def test_smooth_frames_get_the_wrinkles_of_the_database(model, database):
    found = model(database.smooth)
    left = (found - database.frames).square().mean().sqrt()
    assert float(left) < 0.4 * float((database.smooth - database.frames).square().mean().sqrt())


def test_a_copy_and_a_saved_model_give_the_same(model, database, tmp_path):
    expected = model(database.smooth[3:5])
    assert torch.equal(copy.deepcopy(model)(database.smooth[3:5]), expected)
    save_model(model, tmp_path / "actor", licence="MIT", data="made", metrics={}, recipe="none")
    assert torch.equal(get_model(tmp_path / "actor")(database.smooth[3:5]), expected)


def test_what_is_not_of_this_mesh_or_unit_is_refused(model, database):
    with pytest.raises(TopologyError, match=r"found \(1, 100, 3\), expected \(T,"):
        model(torch.zeros(1, 100, 3))
    with pytest.raises(AlignmentError, match="10 times as large as the neutral"):
        model(10 * database.smooth[2:4])
    with pytest.raises(TopologyError, match="another order"):
        model(database.smooth[2:4, torch.randperm(len(database.neutral))])
    broken = database.smooth[2:4].clone()
    broken[1, 7] = math.nan
    with pytest.raises(ValueRangeError, match="frame 1 holds NaN"):
        model(broken)


def test_a_database_that_cannot_be_learned_from_is_told(database):
    def fit(frames=database.frames, sequences=database.sequences):
        return EnhancementModel.fit(frames, database.faces, sequences, database.neutral, rank=4)

    broken = database.frames.clone()
    broken[5, 7] = math.nan
    with pytest.raises(ValueRangeError, match="frame 5 holds NaN"):
        fit(broken)
    with pytest.raises(ValueRangeError, match="4 sequences in 36 pieces"):
        fit(sequences=torch.arange(36) % 4)
    with pytest.raises(TopologyError, match=r"expected \(K,"):
        fit(database.frames[:, :-1])
    with pytest.warns(UserWarning, match="found 1 of 36 frames"):
        fit(sequences=torch.zeros(36, dtype=torch.int64))
    with pytest.warns(UserWarning, match=r"nearer to the neutral than \d"):
        fit(database.frames[12:15], torch.tensor([0, 0, 1]))
