"""The recipe of face boxes end to end on a few planted cut-outs: what it saves is what it has learned and measured."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchface import TorchfaceError, zoo
from torchface.landmarks import BoxNetwork, BoxTrainingSettings
from torchface.synthetic.stages.face_scenes import SceneSettings
from train import face_boxes as recipe
from train.face_boxes import Settings, train
from train.face_pictures import FacePictures


def planted(*_: object) -> FacePictures:
    """Ten cut-outs of noise with landmarks anywhere."""
    generator = torch.Generator().manual_seed(1)
    rgba = torch.randint(1, 255, (10, 4, 48, 48), generator=generator, dtype=torch.uint8)
    return FacePictures(rgba, 12 + 24 * torch.rand(10, 68, 2, generator=generator), torch.ones(10, 68).bool())


def test_what_is_saved_is_what_was_learned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recipe, "render_pictures", planted)
    learning = BoxTrainingSettings(16, 8, channels=(8, 8, 8, 8), blocks=(1, 1, 1, 1), checkpoint=1)
    out = tmp_path / "boxes"
    model, measured = train(
        Settings(tmp_path / "pictures", out=out, tested=2, scenes=SceneSettings(size=64, largest=50), training=learning)
    )
    saved = zoo.get_model(out)
    assert isinstance(saved, BoxNetwork)
    for name, value in model.state_dict().items():  # convolutions are kept in half precision
        torch.testing.assert_close(saved.state_dict()[name].to(value), value, rtol=1e-3, atol=1e-4, msg=name)
    record = zoo.describe(out)
    assert record.metrics == pytest.approx(measured)
    assert record.settings["training"]["pictures"] == 16
    assert not (out / "checkpoint.safetensors").exists()


def test_settings_that_cannot_be_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TorchfaceError, match="found held_out 1"):
        train(Settings(out=tmp_path, held_out=1.0))
