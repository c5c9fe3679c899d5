"""Small documents: values of the right type, errors that name file, key, what was found and what was expected."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from torchface.errors import FileFormatError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key
from torchface.files.documents import Value, read_json, read_toml, write_json, write_toml

TEXT = """
format = "test/1"
name = "a"
count = 3
size = 2.5
flag = true
names = ["a", "b"]
[table]
point = [1, 2.5, 3]
rows = [[1, 2], [3, 4]]
ragged = [[1, 2], [3]]
huge = 1e300
ids = [0, 7]
"""


@pytest.fixture
def document(tmp_path: Path) -> Value:
    (tmp_path / "d.toml").write_text(TEXT)
    return read_toml(tmp_path / "d.toml", "test/1")


def test_values_are_read_by_type(document: Value) -> None:
    assert (document["name"].text(), document["count"].whole(), document["size"].number()) == ("a", 3, 2.5)
    assert document["names"].texts() == ("a", "b")
    assert [value.text() for value in document["names"].rows()] == ["a", "b"]
    assert not document["absent"]
    table = document["table"]
    assert table["point"].tensor(3).tolist() == [1, 2.5, 3]
    assert table["rows"].tensor(None, 2, dtype=torch.float32).equal(torch.tensor([[1.0, 2], [3, 4]]))
    assert table["ids"].tensor(None, dtype=torch.int64).equal(torch.tensor([0, 7]))
    assert Value("x", "", []).tensor(None, 3).shape == (0, 3)
    assert set(document.plain_table()) == set(document.table())


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (lambda d: d["absent"].text(), "d.toml: found absent = None, expected text"),
        (lambda d: d["count"].text(), "found count = 3, expected text"),
        (lambda d: d["flag"].whole(), "found flag = True, expected a whole number from 0 to"),
        (lambda d: d["flag"].number(), "found flag = True, expected a finite number"),
        (lambda d: d["size"].whole(), "found size = 2.5, expected a whole number"),
        (lambda d: d["count"].whole(4, 9), "found count = 3, expected a whole number from 4 to 9"),
        (lambda d: d["table"]["huge"].number(), r"found table.huge = 1e\+300, expected a finite number"),
        (lambda d: d["table"]["point"].tensor(2), r"found table.point = \[1, 2.5, 3\], expected finite numbers \(2\)"),
        (lambda d: d["table"]["point"].tensor(3, dtype=torch.int64), r"expected whole numbers \(3\)"),
        (lambda d: d["table"]["ragged"].tensor(None, None), r"expected finite numbers \(N,N\)"),
        (lambda d: d["table"]["point"].tensor(None, 3), r"expected finite numbers \(N,3\)"),
        (lambda d: d["name"]["inner"], "found name = 'a', expected a table"),
        (lambda d: d["table"].table("point", "rows"), "found table.huge = 1e.*expected only point, rows"),
        (lambda d: d["names"].rows(0, 1, "one name"), r"found names = \['a', 'b'\], expected one name"),
        (lambda d: d["table"]["point"].texts(), "expected a list of texts"),
        (lambda d: d["table"]["rows"].rows()[1].text(), r"found table.rows\[1\] = \[3, 4\], expected text"),
    ],
)
def test_errors_name_file_key_found_and_expected(
    document: Value, read: Callable[[Value], object], message: str
) -> None:
    with pytest.raises(FileFormatError, match=message):
        read(document)


def test_files_are_refused_before_they_are_read(tmp_path: Path) -> None:
    path = tmp_path / "d.json"
    for text, message in (
        ("{", "d.json: not JSON"),
        ("[" * 999, "d.json: not JSON"),
        ("\0" + "[" * 999, "d.json: not JSON .found a byte 0, expected text"),
        ("[]", 'found format None, expected "test/1"'),
        ('{"format": "test/2"}', "found format 'test/2', expected \"test/1\""),
        (" " * 2000, "found 2000 bytes, expected at most 1000"),
    ):
        path.write_text(text)
        with pytest.raises(FileFormatError, match=message):
            read_json(path, "test/1", max_bytes=1000)
    path.write_text('{"a": NaN, "b": 1e999, "c": [null]}')
    for read in (lambda d: d["a"].number(), lambda d: d["b"].number(), lambda d: d["c"].tensor(1)):
        with pytest.raises(FileFormatError, match="found"):
            read(read_json(path))


def test_what_is_written_is_whole_and_read_by_any_program(tmp_path: Path) -> None:
    write_json(tmp_path / "d.json", {"a": [1.5, float("nan")], "b": {"c": float("inf")}})
    assert json.loads((tmp_path / "d.json").read_text(), parse_constant=pytest.fail) == {
        "a": [1.5, None],
        "b": {"c": None},
    }
    write_toml(tmp_path / "d.toml", {"a": None, "b": {"c": None, "d": 1}, "e": ("x",)})
    assert read_toml(tmp_path / "d.toml").found == {"b": {"d": 1}, "e": ["x"]}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d.json", "d.toml"]
    with pytest.raises(FileFormatError, match="cannot be written"):
        write_json(tmp_path / "none" / "d.json", {})


def test_a_checkpoint_belongs_to_one_thing(tmp_path: Path) -> None:
    path, key = tmp_path / "c.safetensors", content_key("test/1", of="a")
    assert read_checkpoint(path, key) is None
    write_checkpoint(path, {"x": torch.arange(6.0).view(2, 3).T}, key)
    found = read_checkpoint(path, key)
    assert found["x"].equal(torch.arange(6.0).view(2, 3).T)
    assert read_checkpoint(path, content_key("test/1", of="b")) is None
    whole = path.read_bytes()
    for damaged in (b"", whole[:-1], whole[:-8] + bytes(8), whole[:40] + b"\xff" + whole[41:]):
        path.write_bytes(damaged)
        with pytest.warns(UserWarning, match=r"c\.safetensors: found a damaged checkpoint"):
            assert read_checkpoint(path, key) is None
    save_file({"x": torch.zeros(1)}, path)
    assert read_checkpoint(path, key) is None
