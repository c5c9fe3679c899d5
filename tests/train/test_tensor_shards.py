"""Rows of many files: those that were asked for, in their order, and files that do not fit are named."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from torchface.errors import FileFormatError, ShapeError
from train.tensor_shards import Shards

COUNTS = (3, 1, 4)
VALUES = torch.arange(8 * 6, dtype=torch.float32).view(8, 2, 3)
FLAGS = torch.arange(8) % 3 == 0


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    found, begin = [], 0
    for number, count in enumerate(COUNTS):
        rows = slice(begin, begin + count)
        found.append(tmp_path / f"{number}.safetensors")
        save_file({"values": VALUES[rows].clone(), "flags": FLAGS[rows].clone(), "more": torch.ones(9)}, found[-1])
        begin += count
    return found


def test_rows_are_those_of_all_files_together(paths: list[Path]) -> None:
    shards = Shards(paths, ["values", "flags"])
    assert (len(shards), shards.counts) == (8, COUNTS)
    for begin in range(8):
        for end in range(begin + 1, 9):
            found = shards.read(begin, end)
            assert torch.equal(found["values"], VALUES[begin:end])
            assert torch.equal(found["flags"], FLAGS[begin:end])
    some = torch.tensor([7, 0, 3, 3, 2])
    assert torch.equal(shards.rows(some)["values"], VALUES[some])
    assert torch.equal(shards.shard(2)["flags"], FLAGS[4:])


def test_what_is_read_outlives_its_file(paths: list[Path]) -> None:
    found = Shards(paths, ["values"]).read(0, 8)["values"]
    for path in paths:
        path.write_bytes(b"\0" * path.stat().st_size)
    assert torch.equal(found, VALUES)


def test_files_that_do_not_fit_are_named(paths: list[Path]) -> None:
    with pytest.raises(FileFormatError, match=r"0 files"):
        Shards([], ["values"])
    with pytest.raises(FileFormatError, match=r"0\.safetensors: cannot be read"):
        Shards(paths, ["absent"])
    with pytest.raises(FileFormatError, match=r"0\.safetensors.*expected one number of rows"):
        Shards(paths, ["values", "more"])
    shards = Shards(paths, ["values"])
    with pytest.raises(ShapeError, match="rows 6 to 9, expected some of 8"):
        shards.read(6, 9)
    whole = paths[2].read_bytes()
    for size in (0, 7, 60, len(whole) - 1):
        paths[2].write_bytes(whole[:size])
        with pytest.raises(FileFormatError, match=r"2\.safetensors"):
            Shards(paths, ["values"])
        with pytest.raises(FileFormatError, match=r"2\.safetensors"):
            shards.rows(torch.tensor([7]))
    save_file({"values": torch.zeros(2, 2, 3)}, paths[2])
    with pytest.raises(FileFormatError, match=r"2\.safetensors"):
        shards.read(0, 8)
    save_file({"values": torch.zeros(4, 2, 4)}, paths[2])
    with pytest.raises(FileFormatError, match=r"2\.safetensors: found .*\(2, 4\).*as in 0\.safetensors"):
        Shards(paths, ["values"])
    paths[0].unlink()
    with pytest.raises(FileFormatError, match=r"0\.safetensors"):
        Shards(paths, ["values"])
