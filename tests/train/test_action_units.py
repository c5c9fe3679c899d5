"""The recipe end to end on a filmed performer."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchface import zoo
from torchface.capture import ActionUnitClassifier
from torchface.capture.action_units.painted_regions import performed_groups
from torchface.errors import NameMismatchError, TorchfaceError
from torchface.io.action_labels import ActionLabels, Performed, RegionGroup, load_action_labels
from train import action_units as recipe
from train.action_units import Settings, train
from train.filmed_performers.action_performance import ACTION_UNITS
from train.filmed_performers.camera_stage import RecordedSession
from train.filmed_performers.label_files import save_action_labels


@pytest.fixture(scope="module")
def session(filmed_session: RecordedSession) -> RecordedSession:
    return filmed_session


def test_a_video_and_its_labels_become_a_model(session: RecordedSession, tmp_path: Path) -> None:
    video, labels = (session.video.path,), (session.labels_path,)
    out = tmp_path / "units"
    trained = train(
        Settings(video=video, labels=labels, test_video=video, test_labels=labels, out=out, size=32, folds=2)
    )
    assert {path.name for path in out.iterdir()} == {
        "model.toml",
        "state.safetensors",
        "CARD.md",
        "levels.png",
        "settings.toml",
        "log.csv",
    }
    again = zoo.get_model(out)
    assert isinstance(again, ActionUnitClassifier)
    assert set(again.units) == set(ACTION_UNITS)
    assert trained.metrics["first, within_one"] > 0.95
    assert trained.metrics["cross-validated accuracy"] > 0.85
    assert "cross-validated accuracy" in (out / "CARD.md").read_text()
    same = zip(again.state_dict().values(), trained.classifier.state_dict().values(), strict=True)
    assert all(torch.equal(a, b) for a, b in same)


def test_what_is_not_performed_is_left_out_what_is_unknown_is_named(session: RecordedSession, tmp_path: Path) -> None:
    some = tuple(stretch for stretch in session.labels.performed if stretch.units in (("9",), ("4",), ("45",)))
    groups = performed_groups([replace(session.labels, performed=some)])
    assert {unit for group in groups for unit in group.units} == {"4", "9", "45"}
    assert "mouth" not in {group.name for group in groups}
    odd = replace(session.labels, performed=(Performed(("99",), 3, 9),))
    with pytest.raises(TorchfaceError, match="found the units 99"):
        performed_groups([odd])
    with pytest.raises(TorchfaceError, match="found 1 videos and 0 files of labels"):
        train(Settings(video=(session.video.path,), labels=(), out=tmp_path / "x"))
    together = replace(session.labels, performed=(Performed(("4", "9"), 5, 20), Performed(("9",), 25, 40)))
    save_action_labels(together, tmp_path / "together.toml")
    with pytest.raises(NameMismatchError, match="4 is never performed alone"):
        train(Settings(video=(session.video.path,), labels=(tmp_path / "together.toml",), out=tmp_path / "x", size=32))


def test_labels_that_are_not_there_end_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--video", str(tmp_path / "film.mp4"), "--labels", str(tmp_path / "film.toml")]
    with pytest.raises(SystemExit):
        recipe.RECIPE.main(words)
    assert "film.toml: found no such file" in " ".join(capsys.readouterr().err.split())


def test_units_of_ones_own_are_grouped_by_the_labels(tmp_path: Path) -> None:
    """A pucker to the right and a frown, which the usual groups do not know, in regions of their own."""
    regions = {"mouth": (10.0, 10.0, 60.0, 40.0), "chin": (10.0, 50.0, 60.0, 80.0)}
    performed = (Performed(("18R",), 5, 20), Performed(("15",), 30, 50))
    groups = (RegionGroup("lips", ("mouth",), ("18R", "16"), ("15",)), RegionGroup("chin", ("chin", "mouth"), ("15",)))
    labels = ActionLabels(60, 0, (5.0, 5.0), ((1.0, 1.0), (9.0, 1.0)), regions, performed, groups)
    save_action_labels(labels, tmp_path / "own.toml")
    again = load_action_labels(tmp_path / "own.toml")
    assert again == labels
    with pytest.warns(UserWarning, match="no frame shows 16, which"):
        found = performed_groups([again])
    assert found == (replace(groups[0], units=("18R",)), groups[1])
    # A unit that no group classifies may be performed, so that it is not taken for one of theirs.
    lips = replace(labels, groups=(RegionGroup("lips", ("mouth",), ("18R",), ("15",)),))
    assert performed_groups([lips]) == lips.groups
    with pytest.raises(NameMismatchError, match="group 'brows' has regions brow and units 4, expected some of mouth"):
        replace(labels, groups=(RegionGroup("brows", ("brow",), ("4",)),))
    with pytest.raises(TorchfaceError, match=r"found the units 15, 18R, expected .*; others need \[\[groups\]\]"):
        performed_groups([replace(labels, groups=())])
