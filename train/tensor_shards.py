"""Rows of tensors that lie in many safetensors files, read a few at a time."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError

_DTYPES = {"F64": torch.float64, "F32": torch.float32, "F16": torch.float16, "U8": torch.uint8, "BOOL": torch.bool}


class Shards:
    """Tensors by name whose rows are divided between files; in memory there is only what is read.

    Only the files' headers are read beforehand. Every read opens a file anew: pages of a mapping that is closed leave
    the memory.
    """

    def __init__(self, paths: Sequence[Path], names: Sequence[str]) -> None:
        if not paths or not names:
            raise FileFormatError(f"shards: found {len(paths)} files and {len(names)} names, expected one of each")
        self.paths, self.names = tuple(paths), tuple(names)
        self.forms: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {}
        """By name: dtype, and size of a row."""
        counts = []
        for path in self.paths:
            with _opened(path) as file:
                forms, rows = {}, set()
                for name in self.names:
                    rows_of_name = file.get_slice(name)
                    size = tuple(rows_of_name.get_shape())
                    if rows_of_name.get_dtype() not in _DTYPES or not size or 0 in size:
                        raise FileFormatError(f"{path}: found {name} {rows_of_name.get_dtype()} {size}, expected rows")
                    forms[name] = _DTYPES[rows_of_name.get_dtype()], size[1:]
                    rows.add(size[0])
            self.forms = self.forms or forms
            if forms != self.forms or len(rows) > 1:
                raise FileFormatError(
                    f"{path}: found {forms} of {sorted(rows)} rows, expected one number of rows, and as in "
                    f"{self.paths[0].name} {self.forms}"
                )
            counts.append(rows.pop())
        self.counts = tuple(counts)
        """Rows of each file."""
        self._ends = torch.tensor(counts).cumsum(0)

    def __len__(self) -> int:
        """Rows of all files."""
        return int(self._ends[-1])

    def shard(self, number: int, begin: int = 0, end: int | None = None) -> dict[str, Tensor]:
        """The rows of one file, or some of them, by name."""
        end = self.counts[number] if end is None else end
        path = self.paths[number]
        with _opened(path) as file:
            tensors = {name: file.get_slice(name)[begin:end].clone() for name in self.names}
        for name, (dtype, size) in self.forms.items():
            if tensors[name].dtype != dtype or tensors[name].shape != (end - begin, *size):
                raise FileFormatError(
                    f"{path}: found {name} {tensors[name].dtype} {tuple(tensors[name].shape)}, expected {dtype} "
                    f"{(end - begin, *size)}"
                )
        return tensors

    def read(self, begin: int, end: int) -> dict[str, Tensor]:
        """Rows ``begin`` to ``end``, without the last, by name."""
        if not 0 <= begin < end <= len(self):
            raise ShapeError(f"shards: found rows {begin} to {end}, expected some of {len(self)}")
        first, last = torch.searchsorted(self._ends, torch.tensor([begin, end - 1]), right=True).tolist()
        parts = []
        for number in range(first, last + 1):
            start = int(self._ends[number]) - self.counts[number]
            parts.append(self.shard(number, max(begin - start, 0), min(end - start, self.counts[number])))
        return {name: torch.cat([part[name] for part in parts]) for name in self.names}

    def rows(self, numbers: Tensor) -> dict[str, Tensor]:
        """The rows of these numbers (B,), in their order, by name."""
        owners = torch.searchsorted(self._ends, numbers, right=True)
        tensors = {name: torch.empty(len(numbers), *size, dtype=dtype) for name, (dtype, size) in self.forms.items()}
        for owner in owners.unique().tolist():  # a file is opened once
            rows = (owners == owner).nonzero()[:, 0]
            start = int(self._ends[owner]) - self.counts[owner]
            with _opened(self.paths[owner]) as file:
                for name in self.names:
                    rows_of_name = file.get_slice(name)
                    for row in rows.tolist():
                        file_row = int(numbers[row]) - start
                        tensors[name][row] = rows_of_name[file_row : file_row + 1][0]
        return tensors


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        with safe_open(path, framework="pt") as file:
            yield file
    except (SafetensorError, OSError, ValueError, RuntimeError, IndexError) as error:
        raise FileFormatError(f"{path}: cannot be read as shard ({error})") from error
