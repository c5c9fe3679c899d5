"""The recipe of the eye network end to end on a few rendered eyes: what it saves is what it has learned."""

from dataclasses import fields
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from torchface import TorchfaceError, zoo
from torchface.landmarks.images.networks.eye_network import EyeNetwork
from torchface.landmarks.images.networks.eye_training import EyeSettings
from train import eye_network as recipe
from train.eye_network import Settings, train
from train.eye_pictures import EyePictures
from train.rendered_files import Rendering
from train.rendered_people.eye_picture import draw_eye_pictures
from train.rendered_people.head_kind import performer_kind


def drawn(_: Rendering, folder: Path, *more: object) -> list[Path]:
    """A file of eight pictures, of which the first four are held out."""
    pictures = draw_eye_pictures((performer_kind(),), (1.0,), 0, 8, seed=3, each=4)
    names = [field.name for field in fields(EyePictures)]
    save_file({name: torch.stack([getattr(one, name) for one in pictures]) for name in names}, folder / "some")
    return [folder / "some"]


def test_what_is_saved_is_what_was_learned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recipe, "rendered_files", drawn)
    monkeypatch.setattr(recipe, "EACH", 4)
    monkeypatch.setattr(recipe, "PART", 4)
    out = tmp_path / "eyes"
    model = train(Settings(out=out, folder=tmp_path, pictures=8, held_out=4, network=EyeSettings(steps=3, batch=4)))
    saved = zoo.get_model(out)
    assert isinstance(saved, EyeNetwork)
    for name, value in model.state_dict().items():  # convolutions are kept in half precision
        torch.testing.assert_close(saved.state_dict()[name].to(value), value, rtol=1e-3, atol=1e-4, msg=name)
    record = zoo.describe(out)
    assert len(record.metrics) == 15
    assert record.settings["network"]["steps"] == 3
    assert {path.name for path in out.iterdir()} >= {"settings.toml", "log.csv"}


def test_too_few_pictures_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TorchfaceError, match="pictures: found 300"):
        train(Settings(out=tmp_path / "eyes", pictures=300))
