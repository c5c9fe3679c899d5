"""Files of expressions say what they show by their names or by a table."""

from pathlib import Path

import pytest
import torch

from torchface.errors import FileFormatError, NameMismatchError, TorchfaceError, ValueRangeError
from torchface.workflows.rig.expression_scans import expressions_in, neutral_in

NAMES = ("jawOpen", "browInnerUp_L", "browInnerUp_R", "mouthSmile_L")


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).write_text("x")


def test_names_tell_shapes_and_weights_in_any_spelling(tmp_path: Path) -> None:
    touch(tmp_path, "jawOpen=0.6+mouthSmileLeft=0.5.obj", "browInnerUp.ply", "Neutral.obj", "jawOpen.ljson", "a.txt")
    first, second = expressions_in(tmp_path, NAMES)
    torch.testing.assert_close(first.weights, torch.tensor([0, 1.0, 1, 0]))
    torch.testing.assert_close(second.weights, torch.tensor([0.6, 0, 0, 0.5]))
    assert first.name == "browInnerUp"
    assert neutral_in(tmp_path) == tmp_path / "Neutral.obj"


def test_a_table_tells_them_in_its_order(tmp_path: Path) -> None:
    touch(tmp_path, "b.obj", "a.obj", "unused.obj")
    (tmp_path / "weights.csv").write_text("scan,jawOpen,mouthSmileLeft\nb.obj,0.7,\na.obj,0,1\n")
    found = expressions_in(tmp_path, NAMES)
    assert [one.name for one in found] == ["b", "a"]
    torch.testing.assert_close(found[0].weights, torch.tensor([0.7, 0, 0, 0]))
    torch.testing.assert_close(found[1].weights, torch.tensor([0.0, 0, 0, 1]))


@pytest.mark.parametrize(
    ("names", "table", "kind", "message"),
    [
        (("smile_01.obj",), None, NameMismatchError, "expected shapes of the template such as jawOpen"),
        (("jawOpen=much.obj",), None, ValueRangeError, "expected SHAPE=WEIGHT"),
        (("jawOpen=2.obj",), None, ValueRangeError, "expected weights from 0 to 1"),
        (("jawOpen=nan.obj",), None, ValueRangeError, "expected weights from 0 to 1"),
        (("jawOpen=0.obj",), None, ValueRangeError, "no weight above 0"),
        (("a.obj",), "scan,jawOpen\nb.obj,1\n", FileFormatError, "found 'b.obj' in the column scan"),
        (("a.obj",), "scan,jawOpen\n../a.obj,1\n", FileFormatError, "expected a file of the same folder"),
        (("a.obj",), "file,jawOpen\na.obj,1\n", FileFormatError, "no column 'scan'"),
        (("a.obj",), "scan,smile\na.obj,1\n", NameMismatchError, "found 'smile'"),
        (("a.obj",), "scan,jawOpen\na.obj,-1\n", ValueRangeError, "expected weights from 0 to 1"),
        (("jawOpen=0.5+jawOpen=0.2.obj",), None, ValueRangeError, "'jawOpen' twice in its name"),
        (("a.obj",), "scan,jawOpen\na.obj,much\n", TorchfaceError, "much"),
        (("a.obj",), "scan,jawOpen\na.obj,1\na.obj,0.5\n", FileFormatError, "more than one row for a.obj"),
        (("a.obj",), "scan,jawOpen\na.obj,\n", ValueRangeError, "no weight above 0"),
    ],
)
def test_mistakes_are_told(
    tmp_path: Path, names: tuple[str, ...], table: str | None, kind: type[TorchfaceError], message: str
) -> None:
    touch(tmp_path, *names)
    if table is not None:
        (tmp_path / "weights.csv").write_text(table)
    with pytest.raises(kind, match=message):
        expressions_in(tmp_path, NAMES)
    with pytest.raises(FileFormatError, match="no such folder"):
        expressions_in(tmp_path / "none", NAMES)
