"""The budget of readers catches what it is there for."""

import time
from pathlib import Path

import numpy as np
import pytest
import reader_budget
from reader_budget import check_budget, measure, memory_budget, time_budget

from torchface.errors import FileFormatError


def takes_memory(path: Path) -> int:
    return int(np.ones(int(path.read_text()) * 2**17).sum())


def takes_time(path: Path) -> None:
    end = time.process_time() + float(path.read_text())
    while time.process_time() < end:
        sum(range(1000))


def refuses(path: Path) -> None:
    raise FileFormatError(f"{path}: found another file")


def leaks(path: Path) -> None:
    raise ValueError("Exceeds the limit for integer string conversion")


def file_of(folder: Path, text: str) -> Path:
    (folder / "file.txt").write_text(text)
    return folder / "file.txt"


def test_memory_and_time_are_those_of_the_reader(tmp_path: Path) -> None:
    cost = check_budget(takes_memory, file_of(tmp_path, "100"))
    assert 100 <= cost.megabytes < 120
    assert cost.refused == ""
    assert 0.2 <= measure(takes_time, file_of(tmp_path, "0.2")).seconds < 0.3


def test_a_reader_over_its_memory_is_caught(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader_budget, "MEGABYTES", 50)
    with pytest.raises(AssertionError, match=r"takes_memory took .* MB for a file of .* and 50 MB"):
        check_budget(takes_memory, file_of(tmp_path, "60"))
    with pytest.raises(AssertionError, match="MemoryError"):
        check_budget(takes_memory, file_of(tmp_path, "3000"))


def test_a_reader_over_its_time_is_caught(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader_budget, "SECONDS", 0.2)
    with pytest.raises(AssertionError, match=r"expected at most 0\.2 s"):
        check_budget(takes_time, file_of(tmp_path, "0.3"))


def test_a_file_may_be_refused_but_no_other_error_passes(tmp_path: Path) -> None:
    path = file_of(tmp_path, "odd")
    assert check_budget(refuses, path).refused == f"{path}: found another file"
    with pytest.raises(AssertionError, match="integer string conversion"):
        check_budget(leaks, path)


def test_larger_files_may_take_more() -> None:
    assert memory_budget(10) == 500
    assert memory_budget(100) == 2000
    assert time_budget(3) == 8
