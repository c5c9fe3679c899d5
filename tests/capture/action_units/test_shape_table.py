"""Tables of action units in a rig's shapes."""

from pathlib import Path

import pytest
import torch

from torchface.capture.action_units.painted_regions import GROUPS
from torchface.capture.action_units.shape_table import ShapeTable, built_in_tables, load_shape_table
from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.io import load_rig
from torchface.synthetic.head.performer import SHAPES

UNITS = tuple(unit for group in GROUPS for unit in group.units)


def test_the_built_in_tables_know_every_unit() -> None:
    assert built_in_tables() == ["arkit", "ict"]
    arkit = load_shape_table("arkit")
    assert arkit.units["18R"] == {"mouthPucker": 0.9, "mouthRight": 0.8}
    assert set(arkit.units) == set(load_shape_table("ict").units) == set(UNITS)
    matrix = arkit.matrix(UNITS, SHAPES)
    assert matrix.shape == (8, 51)
    assert matrix[UNITS.index("18L"), SHAPES.index("mouthLeft")] == pytest.approx(0.8)


@pytest.mark.bench
@pytest.mark.real
def test_the_table_of_a_real_rig_names_its_shapes(ict_folder: Path) -> None:
    names = load_rig(ict_folder, part="face").names
    matrix = load_shape_table("ict").matrix(UNITS, names)
    assert (matrix > 0).any(1).all()
    assert matrix[UNITS.index("1+2")].sum() == 4


def test_a_table_comes_back_as_it_was(tmp_path: Path) -> None:
    table = ShapeTable({"4": {"frown": 0.7, "squeeze": 0.2}})
    table.save(tmp_path / "mine.toml")
    assert load_shape_table(tmp_path / "mine.toml") == table
    assert torch.equal(table.matrix(["9", "4"], ["squeeze", "frown"]), torch.tensor([[0, 0], [0.2, 0.7]]))


def test_what_cannot_be_is_named(tmp_path: Path) -> None:
    with pytest.raises(NameMismatchError, match="found no 'maya'"):
        load_shape_table("maya")
    with pytest.raises(FileFormatError, match="no such file"):
        load_shape_table(tmp_path / "missing.toml")
    with pytest.raises(NameMismatchError, match="browInnerUp"):
        load_shape_table("arkit").matrix(UNITS, ["jawOpen"])
    for text, kind in (
        ("units = 3", FileFormatError),
        ('format = "torchface.action_unit_shapes/1"\n[units]\n"4" = { frown = "much" }', FileFormatError),
        ('format = "torchface.action_unit_shapes/1"\n[units]\n"4" = { frown = 1.5 }', ValueRangeError),
        ('format = "torchface.action_unit_shapes/1"\n[units]\n"4" = {}', NameMismatchError),
        ("[units", FileFormatError),
    ):
        (tmp_path / "bad.toml").write_text(text)
        with pytest.raises(kind, match=r"bad\.toml"):
            load_shape_table(tmp_path / "bad.toml")
