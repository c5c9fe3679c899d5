"""Named arrays of a NumPy archive or a safetensors file: looked at before they are read, and never unpickled."""

import lzma
import zipfile
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.input_files import note_read

LARGEST_ARRAYS = 2**31  # bytes of all arrays that are read of a file
_LARGEST_FILE, _MOST_ENTRIES, _MOST_VERTICES, _HEADER = 2**32, 1000, 2**20, 2**16
_LARGEST_NUMBER = 1e6  # of a model's lengths in its own unit, far above any
_PICKLES = (".pkl", ".pickle", ".pt", ".pth", ".ckpt")
# Among what zipfile raises: RuntimeError of an encrypted entry, NotImplementedError of a compression without a reader.
_BROKEN = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, SafetensorError),
    *(OSError, ValueError, EOFError, ArithmeticError, RuntimeError),
)
ONLY = "array"  # the name of what a .npy holds
_HOW = (
    "A pickle runs what its author wrote, so torchface opens none. Convert it once, in a process of its own, with the "
    "script of the page Head models of others (docs/how_to/head_models.md): it lets numpy's and scipy's arrays through "
    "and nothing else, and writes an .npz of plain arrays"
)


@dataclass(frozen=True)
class StoredArray:
    """An array of a file as its header has it: shape, kind of number (``f``, ``i``, ``b`` or ``U``) and bytes."""

    shape: tuple[int, ...]
    kind: str
    size: int


class ArrayFile:
    """The arrays of a file by name, read one by one, of at most ``largest`` bytes together."""

    def __init__(self, path: str | Path, largest: int = LARGEST_ARRAYS) -> None:
        self.path = Path(path)
        self._left = largest
        self._archive: dict[str, zipfile.ZipInfo] | None = None
        if not self.path.is_file():
            raise FileFormatError(f"{self.path}: found no such file, expected .npz or .safetensors")
        if self.path.stat().st_size > _LARGEST_FILE:
            raise FileFormatError(
                f"{self.path}: found {self.path.stat().st_size} bytes, expected at most {_LARGEST_FILE}"
            )
        if is_pickle(self.path):
            raise FileFormatError(f"{self.path}: found a pickle or a file that may hold one, expected .npz. {_HOW}")
        note_read(self.path)
        with self.path.open("rb") as file:
            begin = file.read(8)
        try:
            if begin[:6] == _NPY:
                self._stored = self._npy_header()
            else:
                self._stored = self._npz_headers() if begin[:2] == b"PK" else self._safetensors_headers()
        except _BROKEN as e:
            raise FileFormatError(f"{self.path}: found no readable arrays ({e}), expected .npz or .safetensors") from e

    def __contains__(self, name: str) -> bool:
        return name in self._stored

    @property
    def names(self) -> tuple[str, ...]:
        """Of all arrays."""
        return tuple(self._stored)

    def shape(self, name: str) -> tuple[int, ...]:
        """Of an array that is there."""
        return self._stored[name].shape

    def first(self, names: Collection[str]) -> str | None:
        """The first of some names that is there."""
        return next((name for name in names if name in self._stored), None)

    def error(self, name: str, expected: str) -> FileFormatError:
        """The error that names file, array, what was found and what was expected."""
        stored = self._stored.get(name)
        if stored is None:
            found = ", ".join(self.names[:12]) or "nothing"
            return FileFormatError(f"{self.path}: found no {name} (but {found}), expected {expected}")
        return FileFormatError(f"{self.path}: found {name} of {stored.kind}{list(stored.shape)}, expected {expected}")

    def numbers(self, name: str, *shape: int | None, finite: bool = True) -> Tensor:
        """An array of real numbers in float32, of a shape in which None is any size; finite ones alone where asked."""
        values = self._read(name, "fiub", shape)
        with np.errstate(over="ignore"):
            read = np.require(values, np.float32, ["C", "W"])
        if finite and not (fine := np.abs(read) < _LARGEST_NUMBER).all():  # NaN is not below it
            rows = np.argwhere(~fine)
            where = (
                f" in {len(np.unique(rows[:, 0]))} of {len(read)} rows, first at {rows[0].tolist()}"
                if read.ndim
                else ""
            )
            raise FileFormatError(
                f"{self.path}: found NaN, infinity or a giant in {name}{where}, expected finite numbers"
            )
        return torch.from_numpy(read)

    def indices(self, name: str, *shape: int | None, below: int, least: int = 0) -> Tensor:
        """An array of whole numbers from ``least`` to less than ``below``, int64."""
        values = self._read(name, "iuf", shape)
        whole = values.astype(np.int64) if values.dtype.kind != "f" else np.rint(values)
        if values.size and (not np.array_equal(whole, values) or values.min() < least or values.max() >= below):
            raise FileFormatError(
                f"{self.path}: found {name} from {values.min()} to {values.max()}, expected whole numbers from {least} "
                f"to {below - 1}"
            )
        return torch.from_numpy(whole.astype(np.int64))

    def texts(self, name: str, count: int) -> tuple[str, ...]:
        """An array of so many texts."""
        values = self._read(name, "US", (count,))
        return tuple(v.decode(errors="replace") if isinstance(v, bytes) else str(v) for v in values.tolist())

    def check_vertices(self, name: str) -> int:
        """The number of vertices of an array (V,3) that is there."""
        stored = self._stored.get(name)
        if stored is None or len(stored.shape) != 2 or stored.shape[1] != 3 or not 3 < stored.shape[0] < _MOST_VERTICES:
            raise self.error(name, f"(V,3) with 4 to {_MOST_VERTICES} vertices")
        return stored.shape[0]

    def _read(self, name: str, kinds: str, shape: tuple[int | None, ...]) -> NDArray[Any]:
        wanted = ",".join("*" if size is None else str(size) for size in shape)
        stored = self._stored.get(name)
        fits = stored is not None and len(stored.shape) == len(shape)
        fits = fits and all(e is None or e == f for e, f in zip(shape, stored.shape, strict=True))  # type: ignore[union-attr]
        if stored is None or not fits or stored.kind not in kinds:
            raise self.error(name, f"({wanted})")
        if stored.size > self._left:
            raise FileFormatError(
                f"{self.path}: found {name} of {stored.size} bytes, expected at most {self._left} for all that is read"
            )
        self._left -= stored.size
        try:
            return self._loaded(name)
        except (*_BROKEN, MemoryError) as error:
            raise FileFormatError(f"{self.path}: {name} cannot be read ({error})") from error

    def _loaded(self, name: str) -> NDArray[Any]:
        if self._archive is None:
            with safe_open(self.path, framework="np") as file:
                return np.asarray(file.get_tensor(name))
        if name not in self._archive:
            with self.path.open("rb") as file:
                return _array(file)
        with zipfile.ZipFile(self.path) as archive, archive.open(self._archive[name]) as entry:
            return _array(entry)

    def _npy_header(self) -> dict[str, StoredArray]:
        self._archive = {}
        with self.path.open("rb") as file:
            shape, _, dtype = _header(file)
        if dtype.hasobject:
            raise FileFormatError(
                f"{self.path}: found an array of objects, which is a pickle, expected numbers. {_HOW}"
            )
        return {ONLY: _stored(shape, dtype)}

    def _npz_headers(self) -> dict[str, StoredArray]:
        entries_by_name: dict[str, zipfile.ZipInfo] = {}
        stored = {}
        with zipfile.ZipFile(self.path) as archive:
            entries = archive.infolist()
            if len(entries) > _MOST_ENTRIES:
                raise FileFormatError(f"{self.path}: found {len(entries)} arrays, expected at most {_MOST_ENTRIES}")
            for entry in entries:
                if not entry.filename.endswith(".npy"):
                    continue
                with archive.open(entry) as file:
                    shape, _, dtype = _header(file)
                name = entry.filename.removesuffix(".npy")
                stored[name], entries_by_name[name] = _stored(shape, dtype), entry
        self._archive = entries_by_name
        return stored

    def _safetensors_headers(self) -> dict[str, StoredArray]:
        stored = {}
        with safe_open(self.path, framework="np") as file:
            for name in file.keys():  # noqa: SIM118
                part = file.get_slice(name)
                kind, shape = part.get_dtype(), tuple(part.get_shape())
                size = int(np.prod([max(n, 1) for n in shape], dtype=object)) * 8
                stored[name] = StoredArray(shape, _KINDS.get(kind, "O"), size)
        return stored


_NPY = b"\x93NUMPY"
_KINDS = {
    **dict.fromkeys(("F16", "F32", "F64"), "f"),
    **dict.fromkeys(("I8", "I16", "I32", "I64"), "i"),
    **dict.fromkeys(("U8", "U16", "U32", "U64"), "u"),
    "BOOL": "b",
}


def _header(file: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = np.lib.format.read_magic(file)
    try:
        if version == (1, 0):
            return np.lib.format.read_array_header_1_0(file, max_header_size=_HEADER)
        if version == (2, 0):
            return np.lib.format.read_array_header_2_0(file, max_header_size=_HEADER)
    except (SyntaxError, TokenError, TypeError, KeyError, RecursionError, MemoryError) as error:  # what parses Python
        raise ValueError(f"no header of an array ({error})") from error
    raise ValueError(f"version {version} of an array")


def _stored(shape: tuple[int, ...], dtype: np.dtype[Any]) -> StoredArray:
    if not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"the shape {shape!s:.80}")
    size = int(np.prod([max(n, 1) for n in shape], dtype=object)) * dtype.itemsize
    return StoredArray(shape, "O" if dtype.hasobject else dtype.kind, size)


def _array(file: Any) -> NDArray[Any]:
    shape, fortran, dtype = _header(file)
    size = int(np.prod(shape, dtype=object)) * dtype.itemsize
    data = file.read(size)
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes where {size} are announced")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")


def is_pickle(path: Path) -> bool:
    """Whether a file begins as a pickle does, or ends as one of them."""
    if path.suffix.lower() in _PICKLES:
        return True
    with path.open("rb") as file:
        return file.read(1) == b"\x80"
