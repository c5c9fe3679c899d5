"""The check of readers catches what it is there for."""

import os
import random
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mutation import SECONDS, check_reader, mutated

from torchface.errors import FileFormatError

GOOD = b"12 vertices 3.5 -7 1e3\n" * 20


def strict(path: Path) -> None:
    if path.read_bytes() != GOOD:
        raise FileFormatError(f"{path}: found other bytes")


def leaks_key_errors(path: Path) -> None:
    if path.read_bytes() != GOOD:
        raise KeyError("count")


def takes_memory(path: Path) -> None:
    if path.read_bytes() != GOOD:
        np.ones(100_000_000)


def takes_time(path: Path) -> None:
    end = time.process_time() + SECONDS + 0.1
    while path.read_bytes() != GOOD and time.process_time() < end:
        sum(range(1000))


def crashes(path: Path) -> None:
    if path.read_bytes() != GOOD:
        os.abort()


@pytest.fixture
def good(tmp_path: Path) -> Path:
    (tmp_path / "good.txt").write_bytes(GOOD)
    return tmp_path / "good.txt"


def test_a_reader_that_refuses_passes(good: Path) -> None:
    report = check_reader(strict, [good], ".txt", cases=50)
    assert report.cases == 50
    assert report.refused >= 45
    assert report.read + report.refused == 50


@pytest.mark.parametrize(
    ("reader", "message"),
    [
        (leaks_key_errors, "KeyError: 'count'"),
        (takes_memory, "MemoryError"),
        (takes_time, "expected at most 2.0 s"),
        (crashes, "the child ended with -6"),
    ],
)
def test_a_reader_that_misbehaves_is_caught_and_its_case_kept(reader: object, message: str, good: Path) -> None:
    with pytest.raises(AssertionError, match=message) as caught:
        check_reader(reader, [good], ".txt", cases=20)
    kept = Path(str(caught.value).split("kept as ")[1].split("\n")[0])
    assert kept.read_bytes() != GOOD
    kept.unlink()


@given(seed=st.integers(0, 2**31))
def test_damages_stay_of_the_size_of_the_file_and_repeat_by_seed(seed: int) -> None:
    data = mutated(GOOD, random.Random(seed))
    assert len(data) < len(GOOD) + 200_000
    assert data == mutated(GOOD, random.Random(seed))


def test_most_damages_change_the_file() -> None:
    generator = random.Random(0)
    assert sum(mutated(GOOD, generator) != GOOD for _ in range(100)) > 80
