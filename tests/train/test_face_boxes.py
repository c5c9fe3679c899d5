"""The recipe of face boxes end to end on a few planted cut-outs: what it saves is what it has learned and measured."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from torchface import TorchfaceError, zoo
from torchface.landmarks import BoxNetwork, BoxTrainingSettings
from train import face_boxes as recipe
from train.face_boxes import Settings, mined_pieces, train
from train.rendered_files import Rendering
from train.rendered_people.face_scenes import SceneSettings, empty_scene


def planted(_: Rendering, folder: Path, *more: object) -> list[Path]:
    """A file of ten cut-outs of noise with landmarks anywhere."""
    generator = torch.Generator().manual_seed(1)
    rgba = torch.randint(1, 255, (10, 4, 48, 48), generator=generator, dtype=torch.uint8)
    landmarks = 12 + 24 * torch.rand(10, 68, 2, generator=generator)
    save_file({"rgba": rgba, "landmarks": landmarks, "visible": torch.ones(10, 68).bool()}, folder / "people")
    return [folder / "people"]


def test_what_is_saved_is_what_was_learned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recipe, "rendered_files", planted)
    monkeypatch.setattr(recipe, "EACH", 1)
    learning = BoxTrainingSettings(2, 8, channels=(8, 8, 8, 8), blocks=(1, 1, 1, 1))
    out = tmp_path / "boxes"
    model, measured = train(
        Settings(
            folder=tmp_path,
            out=out,
            people=10,
            held_out=2,
            tested=2,
            mined=2,
            scenes=SceneSettings(size=64, largest=50),
            training=learning,
        )
    )
    saved = zoo.get_model(out)
    assert isinstance(saved, BoxNetwork)
    for name, value in model.state_dict().items():  # convolutions are kept in half precision
        torch.testing.assert_close(saved.state_dict()[name].to(value), value, rtol=1e-3, atol=1e-4, msg=name)
    record = zoo.describe(out)
    assert record.metrics == pytest.approx(measured)
    assert record.settings["training"]["steps"] == 2


def test_mistakes_are_cut_out_of_pictures_without_people() -> None:
    """A network that takes every cell for a face errs in each picture; what is cut out shows no face to learn."""
    network = BoxNetwork((4, 4, 4, 4), (1, 1, 1, 1), faces=4)
    with torch.no_grad():
        network.said.bias[0] = 3.0
    pieces = mined_pieces(network.eval(), 3, 64, 1)
    assert len(pieces) >= 3
    assert all(piece.shape == (64, 64, 3) for piece in pieces)
    shown = [empty_scene(pieces[0], np.random.default_rng(seed)) for seed in range(2)]
    assert all(one.image.shape == (3, 64, 64) and len(one.faces) == 0 for one in shown)
    assert not torch.equal(shown[0].image, shown[1].image)


def test_settings_that_cannot_be_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TorchfaceError, match="found --held-out 4 of --people 4"):
        train(Settings(out=tmp_path / "boxes", people=4, held_out=4))
