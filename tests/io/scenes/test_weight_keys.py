"""Few keys instead of one a frame in files that share times and in files whose curves have their own."""

from pathlib import Path

import numpy as np
import pytest
import torch
from maya_scene import MayaScene
from rig_samples import corrective_sheet

from torchface.io import load_animation, save_animation
from torchface.take import Take, Track

BOUND = 2e-3


@pytest.mark.parametrize("ending", [".glb", ".usdc", ".ma"])
def test_few_keys_stay_within_the_bound_of_every_frame(ending: str, tmp_path: Path) -> None:
    rig, frames = corrective_sheet(), 200
    times = torch.arange(frames) / 60
    values = torch.stack([0.5 + 0.4 * torch.sin(2 * times), (0.8 * times % 1.9).clamp(0, 1), 0.3 * times / 4], 1)
    take = Take(60.0, weights=Track(rig.names, values[..., None]))
    path = tmp_path / f"take{ending}"
    reduction = save_animation(rig, take, path, reduce=BOUND).reduction
    assert reduction.largest <= BOUND
    at = times.double().numpy()
    if ending == ".ma":
        curves = MayaScene.read(path).of_kind("animCurveTU")
        keys = [np.array(node.values[".ktv"], float).reshape(-1, 2) for node in curves.values()]
        found = np.stack([np.interp(60 * at, *key.T) for key in keys], 1)
        assert (reduction.before, reduction.after) == (3 * frames, sum(map(len, keys)))
        assert len(keys[2]) == 2  # a straight line
    else:
        read = load_animation(path)
        assert (reduction.before, reduction.after) == (frames, len(read))
        keys = rig.activation(read.weights.values[..., 0]).double().numpy()  # as the file has the correctives
        key_times = read.times.numpy()
        exact = rig.activation(values).numpy()
        combined = np.stack([np.interp(at, key_times, column) for column in keys.T], 1)
        assert np.abs(combined - exact).max() <= BOUND + 1e-6
        found = np.stack([np.interp(at, key_times, column) for column in read.weights.values[..., 0].numpy().T], 1)
    assert np.abs(found - values.numpy()).max() <= BOUND + 1e-6
    assert reduction.after < 0.4 * reduction.before
