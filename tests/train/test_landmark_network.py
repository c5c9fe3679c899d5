"""The recipe for the landmark network: pictures that stay in files give what pictures in memory give."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.utils.data import TensorDataset

from torchface import zoo
from torchface.errors import FileFormatError, ValueRangeError
from torchface.io import save_image, save_pts
from torchface.landmarks import LandmarkNetwork, NetworkSettings
from train import landmark_network as recipe
from train.face_pictures import StoredPictures
from train.rendered_people.face_picture import draw_pictures
from train.rendered_people.head_kind import performer_kind
from train.run_log import read_log

SMALL = {"size": 64, "margin": 1.25, "channels": (8, 12, 16, 24), "blocks": (1, 1, 1), "decoder": 16}
QUICK = NetworkSettings(steps=3, batch=4)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("pictures")
    paths = [folder / f"{number}.safetensors" for number in range(2)]
    for number, path in enumerate(paths):
        drawn = draw_pictures((performer_kind(),), (1.0,), 3 * number, 3, seed=2)
        names = ("rgba", "landmarks", "visible", "points", "point_visible", "weights")
        save_file({name: torch.stack([getattr(one, name) for one in drawn]) for name in names}, path)
    return paths


@pytest.mark.bench  # the network that ships learns for seconds
def test_the_network_learns_the_habit_of_annotators(files: list[Path], tmp_path: Path) -> None:
    """Annotators who set all points lower: it comes nearer to them, and keeps its points and weights beside the 68."""
    data = tmp_path / "photographs"
    data.mkdir()
    stored = load_file(files[0])
    for number in range(3):
        save_image(stored["rgba"][number, :3].float() / 255, data / f"{number}.png")
        save_pts(stored["landmarks"][number] + torch.tensor([0.0, 8.0]), data / f"{number}.pts")
    quick = NetworkSettings(steps=12, batch=4, rate=5e-4, average=0.5, heat=0.0)
    settings = recipe.Settings(out=tmp_path / "own", start="zoo", data=data, network=quick)
    tuned = recipe.train(settings)
    before, after = zoo.describe(tmp_path / "own").metrics.values()
    assert after < 0.8 * before
    assert tuned.config == zoo.get_model("landmark_network", LandmarkNetwork).config
    assert "annotated pictures of photographs, after landmark_network" in zoo.describe(tmp_path / "own").data
    for name in ("1.pts", "2.pts"):
        (data / name).unlink()
    with pytest.raises(ValueRangeError, match="data: found 1 annotated face"):
        recipe.train(settings)


def small() -> LandmarkNetwork:
    torch.manual_seed(3)
    return LandmarkNetwork(**SMALL)


@pytest.mark.parametrize("workers", [0, 1])
def test_files_give_what_memory_gives_also_after_a_stop(files: list[Path], workers: int, tmp_path: Path) -> None:
    settings = NetworkSettings(steps=3, batch=4, workers=workers, checkpoint_every=0)

    def stop(_: str, done: int = 0, total: int = 0) -> None:
        if done == 2:
            raise KeyboardInterrupt

    parts = [load_file(path) for path in files]
    held = (torch.cat([part[name] for part in parts])[:5] for name in ("rgba", "landmarks", "visible"))
    expected = LandmarkNetwork.fit(TensorDataset(*held), small(), settings).state_dict()
    with pytest.raises(KeyboardInterrupt):
        LandmarkNetwork.fit(StoredPictures(files, 5), small(), settings, stop, tmp_path / "part")
    assert (tmp_path / "part").exists()
    found = LandmarkNetwork.fit(StoredPictures(files, 5), small(), settings, None, tmp_path / "part").state_dict()
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=0, atol=0, msg=name)


def test_the_recipe(files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recipe, "PART", 3)
    monkeypatch.setattr(recipe, "EACH", 2)
    monkeypatch.setattr(recipe, "rendered_files", lambda *_: files)
    zoo.save_model(small(), tmp_path / "start", zoo.ModelCard("MIT", "none", {}, ""))
    settings = recipe.Settings(
        out=tmp_path / "own", pictures=6, held_out=3, start=str(tmp_path / "start"), size=64, network=QUICK
    )
    model = recipe.train(settings)
    assert model.config == {
        **SMALL,
        "channels": [8, 12, 16, 24],
        "blocks": [1, 1, 1],
        "points": 452,
        "hidden": 176,
    }
    assert model.places.shape == (452, 3)
    again = zoo.get_model(tmp_path / "own")
    assert isinstance(again, LandmarkNetwork)
    assert again.config == model.config
    told = {row.name: row.value for row in read_log(tmp_path / "own" / "log.csv")}
    measured = zoo.describe(tmp_path / "own").metrics
    assert set(told) == {"pixels off", "learning rate", *measured}
    assert {name: told[name] for name in measured} == pytest.approx(measured, nan_ok=True)
    assert not settings.work.exists()


def test_files_of_something_else_are_refused(files: list[Path], tmp_path: Path) -> None:
    odd = tmp_path / "odd.safetensors"
    save_file({**load_file(files[0]), "landmarks": torch.zeros(3, 5, 2)}, odd)
    with pytest.raises(FileFormatError, match=r"odd\.safetensors: found"):
        StoredPictures([odd])
    with pytest.raises(FileFormatError, match=r"odd\.safetensors: found .* as in 0\.safetensors"):
        StoredPictures([files[0], odd])
    odd.write_bytes(files[0].read_bytes()[:-9])
    with pytest.raises(FileFormatError, match=r"odd\.safetensors: cannot be read"):
        StoredPictures([odd])


def test_half_of_what_a_network_knew_stays() -> None:
    """A network keeps a share of the weights that it had before, and of what it has learned the rest."""
    model, other = small(), small()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    with torch.no_grad():
        for value in model.parameters():
            value.add_(torch.rand_like(value))
    other.load_state_dict(model.state_dict())
    recipe.keep(model, before, 0.0)
    torch.testing.assert_close(model.state_dict(), other.state_dict(), rtol=0, atol=0)
    recipe.keep(model, before, 0.25)
    for name, value in model.state_dict().items():
        torch.testing.assert_close(
            value.double(), 0.75 * other.state_dict()[name].double() + 0.25 * before[name].double()
        )


def test_a_share_of_no_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueRangeError, match=r"--kept: found 0.5, expected \[0,1\), and 0 without --start"):
        recipe.train(recipe.Settings(out=tmp_path / "own", kept=0.5))
