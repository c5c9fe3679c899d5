"""The recipe of the network of a face's parts end to end on a few rendered people: what it saves is what it learned."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from torchface import TorchfaceError, zoo
from torchface.landmarks.images.networks.part_network import PARTS, PartNetwork
from torchface.landmarks.images.networks.part_training import PartSettings
from train import face_parts as recipe
from train.face_parts import Settings, train
from train.rendered_people import part_picture
from train.rendered_people.head_kind import performer_kind
from train.rendered_people.part_picture import PartPicture, draw_part_pictures

NAMES = tuple(PartPicture.__annotations__)


@pytest.fixture(scope="module")
def pictures() -> list[PartPicture]:
    return draw_part_pictures((performer_kind(),), (1.0,), 0, 4, seed=3, each=1, scenes=2)


def test_a_face_has_its_parts_in_their_places(pictures: list[PartPicture]) -> None:
    for picture in pictures:
        x, y, side, _ = picture.box.tolist()
        shown = picture.parts[int(y) : int(y + side), int(x) : int(x + side)]
        assert float((picture.parts[:8] == PARTS.index("background")).float().mean()) > 0.3
        assert {"skin", "hair"} & {PARTS[number] for number in shown.unique().tolist()}
        assert int(picture.parts.max()) < len(PARTS)
    first, again = pictures[0], draw_part_pictures((performer_kind(),), (1.0,), 0, 2, seed=3, each=1, scenes=2)[0]
    assert torch.equal(first.image, again.image)
    assert torch.equal(first.parts, again.parts)


def test_a_neckline_parts_skin_from_cloth_in_the_persons_own_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(part_picture, "_BARE", 1.0)
    shares = []
    for picture in draw_part_pictures((performer_kind(),), (1.0,), 0, 6, seed=4, each=1, scenes=1):
        x, y, side, _ = picture.box.tolist()
        below = picture.parts[int(y + side) :, int(x) : int(x + side)]
        colors = picture.image.permute(1, 2, 0).float()
        face = picture.parts == PARTS.index("skin")
        neck = face.clone()
        neck[: int(y + 1.05 * side)] = False
        if int(neck.sum()) < 200:
            continue
        ratio = colors[neck].mean(0) / colors[face & ~neck].mean(0)
        assert float(ratio.max() / ratio.min()) < 1.25  # of one hue, in whatever light
        shares.append(float((below == PARTS.index("cloth")).float().mean()))
    assert len(shares) >= 3
    assert max(shares) > 0.1


def test_what_is_saved_is_what_was_learned(
    pictures: list[PartPicture], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_file({name: torch.stack([getattr(one, name) for one in pictures]) for name in NAMES}, tmp_path / "some")
    monkeypatch.setattr(recipe, "rendered_files", lambda *_: [tmp_path / "some"])
    for name, count in (("EACH", 1), ("SCENES", 2), ("PART", 2)):
        monkeypatch.setattr(recipe, name, count)
    out = tmp_path / "parts"
    model = train(Settings(out=out, folder=tmp_path, pictures=4, held_out=2, network=PartSettings(steps=3, batch=2)))
    saved = zoo.get_model(out)
    assert isinstance(saved, PartNetwork)
    for name, value in model.state_dict().items():  # convolutions are kept in half precision
        torch.testing.assert_close(saved.state_dict()[name].to(value), value, rtol=1e-3, atol=1e-4, msg=name)
    assert len(zoo.describe(out).metrics) == len(PARTS)


def test_too_few_pictures_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TorchfaceError, match="pictures: found 300"):
        train(Settings(out=tmp_path / "parts", pictures=300))


def test_a_model_of_another_kind_is_refused_before_pictures_are_drawn(tmp_path: Path) -> None:
    with pytest.raises(TorchfaceError, match="a HeadModel, expected a PartNetwork"):
        train(Settings(out=tmp_path / "out", folder=tmp_path / "pictures", start="head"))
    assert not (tmp_path / "pictures").exists()
