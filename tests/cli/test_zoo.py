"""``torchface zoo`` lists what models there are and which are damaged."""

import hashlib
import shutil
from pathlib import Path

import pytest

from torchface import zoo
from torchface.capture.priors import ShapePrior
from torchface.cli import main


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user's own folder with a model that is whole, and one whose last byte has turned over."""
    monkeypatch.setenv(zoo.HOME, str(tmp_path))
    card = zoo.ModelCard("CC0", "nobody's weights", {"held out": 0.125}, "python -m ours", "A prior of ours. More.")
    zoo.save_model(zoo.get_model("shape_prior"), tmp_path / "whole", card)
    shutil.copytree(tmp_path / "whole", tmp_path / "turned")
    state = (tmp_path / "turned" / zoo.STATE).read_bytes()
    (tmp_path / "turned" / zoo.STATE).write_bytes(state[:-1] + bytes([state[-1] ^ 1]))
    return tmp_path


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    main(["zoo", *words])
    return capsys.readouterr().out


def test_the_list_has_a_line_a_model(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = {line.split()[0]: line.split() for line in printed(capsys, "list").splitlines()[1:]}
    assert set(lines) == set(zoo.list_models())
    assert lines["whole"] == ["whole", "shape_prior", "11", "kB", "CC0", "A", "prior", "of", "ours"]
    assert lines["marker_solver"][1] == "marker_solver"


def test_what_cannot_be_loaded_is_listed_as_damaged(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (home / "turned" / zoo.STATE).unlink()
    told = printed(capsys, "list")
    assert "turned            damaged" in told
    assert f"turned: {home / 'turned' / zoo.STATE}: found no such file" in told


def test_a_description_has_what_the_record_has(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = " ".join(printed(capsys, "describe", "whole").split())
    digest = hashlib.sha256((home / "whole" / zoo.STATE).read_bytes()).hexdigest()
    for words in ("shape_prior (ShapePrior)", "CC0", "nobody's weights", "held out 0.125", "python -m ours", "file://"):
        assert words in told
    assert digest in told.replace(" ", "")


def test_a_damaged_model_ends_the_check_with_status_1(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        printed(capsys, "verify", "turned", "whole")
    assert ended.value.code == 1
    damaged, whole = capsys.readouterr().out.splitlines()
    found = hashlib.sha256((home / "turned" / zoo.STATE).read_bytes()).hexdigest()
    assert damaged.startswith(f"turned: damaged: {home / 'turned' / zoo.STATE}: found sha256 {found}, expected ")
    assert zoo.describe("whole").sha256 in damaged
    assert whole == f"whole: whole, 11 kB, sha256 {zoo.describe('whole').sha256}"


def test_all_that_ship_are_whole(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv(zoo.HOME, raising=False)
    lines = [line.split(", ")[0] for line in printed(capsys, "verify").splitlines()]
    assert lines == [f"{name}: whole" for name in zoo.list_models()]


def test_a_missing_card_is_told(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (home / "whole" / "CARD.md").unlink()
    with pytest.raises(SystemExit):
        printed(capsys, "verify", "whole")
    assert "CARD.md: found no such file, expected the model's card" in capsys.readouterr().out
    assert isinstance(zoo.get_model("whole"), ShapePrior)


def test_a_mistyped_name_is_a_mistake(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        printed(capsys, "verify", "hole")
    assert ended.value.code == 2
    assert "found no 'hole', expected one of" in capsys.readouterr().err


def test_a_narrow_terminal_keeps_words_whole(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    words = printed(capsys, "describe", "landmark_network").split()
    assert {"iBUG's", "landmarks", "landmark_network", "MIT"} <= set(words)
