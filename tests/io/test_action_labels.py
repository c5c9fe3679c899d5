"""Labels of a video come back as they were written; what cannot be is named."""

from dataclasses import replace
from pathlib import Path

import pytest

from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.io.action_labels import ActionLabels, Performed, load_action_labels
from train.filmed_performers.label_files import save_action_labels

LABELS = ActionLabels(
    100,
    3,
    (50.5, 4.25),
    ((10.0, 40.0), (90.0, 41.0)),
    {"mouth": (30.0, 60.0, 70.0, 90.0), "brow_left": (50.0, 10.0, 80.0, 25.0)},
    (Performed(("1+2",), 10, 40), Performed(("1+2", "4"), 50, 90)),
    offset=-0.5,
)


def test_they_come_back_as_they_were(tmp_path: Path) -> None:
    save_action_labels(LABELS, tmp_path / "labels.toml")
    assert load_action_labels(tmp_path / "labels.toml") == LABELS
    assert LABELS.units == ("1+2", "4")


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueRangeError, match="100 frames"):
        replace(LABELS, performed=(Performed(("4",), 90, 101),))
    with pytest.raises(ValueRangeError, match="neutral frame"):
        replace(LABELS, neutral=100)
    with pytest.raises(ValueRangeError, match="'mouth'"):
        replace(LABELS, regions={"mouth": (30.0, 60.0, 30.5, 90.0)})
    with pytest.raises(NameMismatchError, match="distinct"):
        replace(LABELS, performed=(Performed(("4", "4"), 0, 10),))
    with pytest.raises(NameMismatchError, match="no region"):
        replace(LABELS, regions={})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("frames = 100", 'frames = "many"', "whole number"),
        ("frames = 100", "frames = 80", "80 frames"),
        ("torchface.action_labels/1", "something", "format"),
        ("[regions]", "[places]", "regions"),
        ("50.5", "nan", "expected 2 numbers"),
        ("neutral = 3", "neutral = ", "not TOML"),
    ],
)
def test_a_damaged_file_is_named(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "labels.toml"
    save_action_labels(LABELS, path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises((FileFormatError, ValueRangeError), match=message) as caught:
        load_action_labels(path)
    assert "labels.toml" in str(caught.value)
