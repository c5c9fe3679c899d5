"""Models by name: they come back as they were, and nothing outside the zoo is reached or run."""

import hashlib
import re
import shutil
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.zoo.conftest import CARD, morphable, noise
from torchface import TorchfaceError, zoo
from torchface.errors import ArgumentTypeError, FileFormatError, NameMismatchError, ValueRangeError
from torchface.modeling.morphable.morphable_model import MorphableModel

REPOSITORY = Path(__file__).resolve().parents[2]


def test_a_model_comes_back_as_it_was(home: Path) -> None:
    assert "mine" in zoo.list_models()
    model, again = morphable(), zoo.get_model("mine")
    assert isinstance(again, MorphableModel)
    assert again.config == model.config
    assert not again.training
    for name, tensor in model.state_dict().items():
        assert torch.equal(again.state_dict()[name], tensor)
        assert again.state_dict()[name].dtype == tensor.dtype
    coefficients = noise(3, model.count)
    assert torch.equal(again(coefficients), model(coefficients))
    assert torch.equal(zoo.get_model(home / "mine")(coefficients), model(coefficients))


def test_half_precision_where_it_is_asked_for(tmp_path: Path) -> None:
    model = morphable()
    whole = zoo.save_model(model, tmp_path / "whole", CARD)
    half = zoo.save_model(model, tmp_path / "half", CARD, half=["components"])
    assert abs(whole.size - half.size - 2 * model.components.numel()) <= 8  # padding of the header
    again = zoo.get_model(tmp_path / "half")
    assert again.components.dtype == torch.float32
    assert torch.equal(again.components, model.components.half().float())
    assert torch.equal(again.mean, model.mean)
    with pytest.raises(ValueRangeError, match="found modes"):
        zoo.save_model(model, tmp_path / "none", CARD, half=["modes"])


def test_a_card_holds_what_its_file_can(tmp_path: Path) -> None:
    settings = {"data": tmp_path, "folders": [Path("a")], "scale": 2.0}
    zoo.save_model(morphable(), tmp_path / "mine", replace(CARD, settings=settings))
    assert zoo.describe(str(tmp_path / "mine")).settings == {"data": str(tmp_path), "folders": ["a"], "scale": 2.0}
    with pytest.raises(ArgumentTypeError, match="expected texts and numbers"):
        zoo.save_model(morphable(), tmp_path / "other", replace(CARD, settings={"rates": {1, 2}}))
    with pytest.raises(ArgumentTypeError, match=r"card\.licence: found an int, expected a str"):
        zoo.save_model(morphable(), tmp_path / "other", replace(CARD, licence=1))
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_the_description_is_what_was_said(home: Path) -> None:
    found = zoo.describe("mine")
    state = (home / "mine" / "state.safetensors").read_bytes()
    assert (found.kind, found.name, found.size) == ("morphable", "mine", len(state))
    assert found.sha256 == hashlib.sha256(state).hexdigest()
    assert (found.licence, found.data, found.metrics, found.recipe) == (
        CARD.licence,
        CARD.data,
        CARD.metrics,
        CARD.recipe,
    )
    assert found.url == (home / "mine").resolve().as_uri()
    zoo.save_model(morphable(), home / "other", replace(CARD, url="https://example.org/m", text="Good for tests."))
    assert zoo.describe("other").url == "https://example.org/m"
    card = (home / "other" / "CARD.md").read_text()
    for words in ("# other", "Good for tests.", "nothing but noise", "MIT", "| error | 0.25 |", "python -m train.none"):
        assert words in card


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """Where models may lie, none there yet: a checkout's folder, the package's, the user's."""
    package = tmp_path / "site" / "torchface"
    package.mkdir(parents=True)
    monkeypatch.setattr("torchface.zoo.model_folders.__file__", str(package / "zoo" / "model_folders.py"))
    monkeypatch.setenv(zoo.HOME, str(tmp_path / "home"))
    return {"checkout": package.parent / "models", "package": package / "_models", "home": tmp_path / "home"}


def project(folder: Path, name: str) -> None:
    (folder / "pyproject.toml").write_text(f'[project]\nname = "{name}"\n')


def test_the_checkouts_models_go_before_the_packages_before_the_users_and_each_loser_is_named(
    places: dict[str, Path], tmp_path: Path
) -> None:
    for folder in places.values():
        zoo.save_model(morphable(), folder / "face", CARD)
    zoo.save_model(morphable(), places["home"] / "own", CARD)
    assert zoo.list_models() == ["face", "own"]
    package, home = places["package"] / "face", places["home"] / "face"
    with pytest.warns(UserWarning, match=re.escape(f"model 'face': {package} goes before {home}; ")) as told:
        assert [zoo.find("face") for _ in range(3)] == [package] * 3
    assert len(told) == 1
    assert (zoo.describe("face").folder, zoo.describe("face").shadowed) == (package, (home,))
    project(tmp_path / "site", "torchface")
    with pytest.warns(UserWarning, match=re.escape(f"goes before {package}, {home}; ")):
        assert zoo.find("face") == places["checkout"] / "face"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert zoo.find("own") == places["home"] / "own"
        assert zoo.describe("own").shadowed == ()
        assert zoo.describe(home).folder == home  # a path is what was asked for


@pytest.mark.parametrize(
    "text", ["", "[project]\n", '[project]\nname = "other"\n', "name = [", "[tool.x]\nproject = 1\n"]
)
def test_a_project_file_beside_the_installed_package_hides_nothing_and_adopts_no_strangers(
    places: dict[str, Path], tmp_path: Path, text: str
) -> None:
    for place in ("checkout", "package"):
        zoo.save_model(morphable(), places[place] / place, CARD)
    (tmp_path / "site" / "pyproject.toml").write_text(text)
    assert zoo.list_models() == ["package"]
    project(tmp_path / "site", "torchface")
    assert "checkout" in zoo.list_models()
    (tmp_path / "site" / "torchface-0.1.0.dist-info").mkdir()  # an installer's: this is no checkout, whatever lies here
    assert zoo.list_models() == ["package"]


def test_a_models_name_cannot_break_the_hub(home: Path) -> None:
    shutil.copytree(home / "mine", home / "dependencies")
    model = torch.hub.load(str(REPOSITORY), "mine", source="local")
    assert isinstance(model, MorphableModel)
    assert torch.equal(model.mean, morphable().mean)


def test_a_home_that_cannot_be_used_is_named(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    iterdir = Path.iterdir

    def locked(folder: Path) -> Iterator[Path]:
        if folder == home:
            raise PermissionError(13, "Permission denied", str(folder))
        return iterdir(folder)

    shipped = [name for name in zoo.list_models() if name != "mine"]
    with monkeypatch.context() as patch:
        patch.setattr(Path, "iterdir", locked)
        with pytest.warns(UserWarning, match=f"{home} cannot be listed"):
            assert zoo.list_models() == shipped
    for odd in (tmp_path / "nowhere", home / "mine" / "model.toml", tmp_path / ("x" * 300)):
        monkeypatch.setenv(zoo.HOME, str(odd))
        assert zoo.list_models() == shipped
        with pytest.raises(NameMismatchError, match=r"TORCHFACE_HOME is .*, which is no folder"):
            zoo.find("nobody")


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../mine", "mine/..", "a b", "-x", "m\0ine", "x" * 65, "x" * 300, "x/" * 300, "nobody"]
)
def test_a_name_that_is_none_is_refused(home: Path, name: str) -> None:
    with pytest.raises(TorchfaceError, match=r"expected one"):
        zoo.get_model(name)


def test_a_folder_beside_the_user_goes_by_its_bare_name(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    zoo.save_model(morphable(), tmp_path / "model12", CARD)
    assert zoo.find("model12").resolve() == tmp_path / "model12"
    assert torch.equal(zoo.get_model("model12").mean, morphable().mean)
    assert zoo.describe("model12").name == "model12"
    (tmp_path / "mine").mkdir()
    assert zoo.find("mine") == home / "mine"
    shutil.copytree(tmp_path / "model12", tmp_path / "mine", dirs_exist_ok=True)  # the zoo's go first
    with pytest.warns(UserWarning, match=f"{home / 'mine'} goes before {tmp_path / 'mine'}"):
        assert zoo.find("mine") == home / "mine"
    (tmp_path / "empty").mkdir()
    with pytest.raises(NameMismatchError, match=r"'empty' \(the folder of that name holds no model.toml\)"):
        zoo.find("empty")


def test_links_that_lead_out_are_not_followed(home: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    shutil.copytree(home / "mine", outside)
    (home / "linked").symlink_to(outside)
    (home / "loop").symlink_to(home / "loop")
    assert zoo.list_models() == sorted({"mine", *zoo.list_models()} - {"linked", "loop"})
    with pytest.raises(NameMismatchError, match="linked"):
        zoo.get_model("linked")
    for name in ("model.toml", "state.safetensors"):
        shutil.copytree(home / "mine", home / "half", dirs_exist_ok=True)
        (home / "half" / name).unlink()
        (home / "half" / name).symlink_to(outside / name)
        with pytest.raises(FileFormatError, match=f"{name}: found a link that leads out"):
            zoo.get_model("half")
        (home / "half" / name).unlink()


def test_a_folder_of_trained_models_is_pointed_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models" / "people").mkdir(parents=True)
    (tmp_path / "models" / "people" / "model.toml").write_text("")
    with pytest.raises(NameMismatchError, match=r"found no 'people', .* \(there is models.people: name it so\)"):
        zoo.find("people")
    with pytest.raises(NameMismatchError, match=r"the path of a model's folder, which goes by its name if it lies in "):
        zoo.find("persons")
