"""``torchface retarget`` onto a rig whose mouthClose opens the jaw."""

from __future__ import annotations

from pathlib import Path

import torch

from torchface import Take, Track, save_rig, save_take
from torchface.capture.mouth_close import with_jaw_in_mouth_close
from torchface.synthetic import performer
from torchface.workflows.retarget_weights import retarget_weights
from torchface.workflows.weight_files import WeightFiles


def test_the_jaw_is_opened_once(tmp_path: Path) -> None:
    rig = performer(texture=False).select(["jawOpen", "mouthClose", "mouthPucker"])
    other = with_jaw_in_mouth_close(rig)
    save_rig(rig, tmp_path / "arkit.glb")
    save_rig(other, tmp_path / "other.glb")
    weights = torch.tensor([[0.8, 0.5, 0.1], [0.3, 0.3, 0.9]])
    save_take(Take(60.0, weights=Track(rig.names, weights[..., None])), tmp_path / "take.csv")
    done = retarget_weights(tmp_path / "take.csv", tmp_path / "other.glb", WeightFiles(tmp_path / "out.csv"))
    assert done.take.weights is not None
    torch.testing.assert_close(other(done.take.weights.values[..., 0]), rig(weights), atol=1e-3, rtol=0)
    assert any("opens the jaw itself" in warning for warning in done.warnings)
    back = retarget_weights(
        tmp_path / "out.csv", tmp_path / "arkit.glb", WeightFiles(tmp_path / "back.csv"), tmp_path / "other.glb"
    )
    assert back.take.weights is not None
    torch.testing.assert_close(back.take.weights.values[..., 0], weights, atol=1e-4, rtol=0)
    table = tmp_path / "table.toml"
    table.write_text("[jawOpen]\nsum = {jawOpen = 1.0}\n")
    written = WeightFiles(tmp_path / "ruled.csv")
    ruled = retarget_weights(tmp_path / "take.csv", tmp_path / "other.glb", written, table=table)
    assert ruled.take.weights is not None
    torch.testing.assert_close(ruled.take.weights.values[..., 0], weights, atol=1e-4, rtol=0)
