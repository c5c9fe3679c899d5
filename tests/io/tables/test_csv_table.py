"""Cells that a spreadsheet would run are written as text, and come back as they were."""

import csv
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchface import Take, Track, load_take, save_take
from torchface.errors import FileFormatError
from torchface.io.tables.csv_table import TableReader, write_table

NAMES = ("=cmd|' /C calc'!A0", "@SUM(1)", "+x", "-y", "'=quoted", "''@twice", "'plain", "jawOpen")


def test_names_that_are_formulas_come_back_and_none_is_run(tmp_path: Path) -> None:
    weights = torch.rand(3, len(NAMES), 1, generator=torch.Generator().manual_seed(0))
    save_take(Take(30.0, weights=Track(NAMES, weights)), tmp_path / "take.csv")
    found = load_take(tmp_path / "take.csv").weights
    assert found.names == NAMES
    assert found.values.equal(weights)
    with (tmp_path / "take.csv").open(newline="") as file:
        header = next(csv.reader(file))
    assert not [cell for cell in header if cell[:1] in "=+-@"]


@given(st.lists(st.text("=@+-'ab", min_size=1, max_size=6), min_size=1, max_size=4))
def test_every_text_comes_back(texts: list[str]) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "table.csv")
        write_table(path, ["name", "number"], [[text, "-0.5"] for text in texts])
        table = TableReader(path).read(["name"])
        for text, line in zip(texts, path.read_text().splitlines()[1:], strict=True):
            assert text[0] not in "=@" or line.lstrip('"').startswith("'")
    assert table.texts["name"] == tuple(texts)
    assert table.numbers.flatten().tolist() == [-0.5] * len(texts)


@pytest.mark.parametrize("name", ["=a", "@b", "-c"])
def test_markers_named_so_come_back(name: str, tmp_path: Path) -> None:
    take = Take(60.0, markers=Track((name,), torch.rand(2, 1, 3)))
    save_take(take, tmp_path / "take.csv")
    found = load_take(tmp_path / "take.csv").markers
    assert found.names == (name,)


@pytest.mark.parametrize("kind", ["semicolons", "UTF-16", "trailing", "trailing spaces", "stated"])
def test_tables_of_other_programs_are_read(kind: str, tmp_path: Path) -> None:
    """Decimal commas between semicolons, UTF-16 as Windows writes it, a comma at the end of each row, Excel's line."""
    text = "frame,time,jawOpen\n0,0.0,0.25\n1,0.04,-1.5e-1\n"
    changed = {
        "semicolons": text.replace(",", ";").replace(".", ",").encode(),
        "UTF-16": text.encode("utf-16"),
        "trailing": text.replace("\n", ",\r\n").encode(),
        "trailing spaces": text.replace("\n", ", \n").encode(),
        "stated": b"\xef\xbb\xbfsep=;\r\n" + text.replace(",", ";").replace(".", ",").encode(),
    }
    (tmp_path / "take.csv").write_bytes(changed[kind])
    table = TableReader(tmp_path / "take.csv").read()
    assert table.names == ("frame", "time", "jawOpen")
    assert table.numbers.tolist() == [[0, 0, 0.25], [1, 0.04, -0.15]]


def test_a_quoted_comma_stands_in_its_cell(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text('frame;"jaw, open"\n0;0,5\n')
    table = TableReader(tmp_path / "take.csv").read()
    assert table.names == ("frame", "jaw, open")
    assert table.numbers.tolist() == [[0, 0.5]]


def test_rows_are_counted_with_excels_line(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text("sep=;\nframe;jawOpen\n0;shut\n")
    with pytest.raises(FileFormatError, match="row 3, column 'jawOpen': found 'shut'"):
        TableReader(tmp_path / "take.csv").read()


@pytest.mark.parametrize(
    ("first", "program"),
    [
        ("Format Version,1.23,Take Name,a,Capture Frame Rate,120.0,Export Frame Rate,120.0", "Motive"),
        ("Trajectories", "Vicon"),
    ],
)
def test_tables_with_several_rows_of_headers_are_refused_with_the_formats_that_are_read(
    tmp_path: Path, first: str, program: str
) -> None:
    (tmp_path / "take.csv").write_text(f"{first}\n\n,,a,a,a\n")
    with pytest.raises(FileFormatError, match=f"{program}'s table with several rows of headers, .* C3D or TRC"):
        load_take(tmp_path / "take.csv")
