"""Head models of eos, such as the Surrey Face Model's ``sfm_shape_3448.bin``: a binary archive of cereal.

Source: the class ``MorphableModel`` of patrikhuber/eos (Apache-2.0), versions 1 to 4, in its members' order.
"""

import struct
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file
from torchface.io.head_models.head_model_file import HeadModelFile, SurfacePlaces
from torchface.mesh import Mesh

NAME = "eos"
ENDING = ".bin"
_VERSIONS = (1, 2, 3, 4)
_MOST_VERTICES, _MOST_NUMBERS, _LARGEST_NUMBER, _LONGEST_NAME = 2**20, 2**28, 1e6, 2**10


def is_eos(path: Path) -> bool:
    """Whether a ``.bin`` begins as eos's models do: a version and a mean of three rows a vertex."""
    if path.suffix.lower() != ENDING:
        return False
    with path.open("rb") as file:
        head = file.read(12)
    if len(head) < 12:
        return False
    version, rows, columns = struct.unpack("<Iii", head)
    return version in _VERSIONS and rows > 0 and rows % 3 == 0 and columns == 1


def read_eos(path: Path) -> HeadModelFile:
    """Reads shape, colour, expressions and landmarks; blendshapes in a file of their own are left out."""
    archive = _Archive(path)
    version = archive.integer("<I")
    mean, identity, faces = archive.model()
    count = len(mean)
    color, _, _ = archive.model()
    expressions = torch.zeros(0, count, 3)
    names: tuple[str, ...] = ()
    if version >= 2 and archive.integer("<B") == 0:
        expressions, names, offset = archive.expressions()
        mean = mean + offset if offset.shape == mean.shape else mean
    landmarks: dict[str, int] = {}
    if version >= 3 and archive.integer("<B") == 0:
        landmarks = {archive.text(): archive.integer("<i") for _ in range(archive.count(12))}
    uvs = archive.numbers("<f8", archive.count(16) * 2).reshape(-1, 2)
    uv_faces = archive.numbers("<i4", archive.count(12) * 3).reshape(-1, 3) if version >= 4 else np.zeros((0, 3))
    for what, ids, below in (("triangles", faces, count), ("texture triangles", uv_faces, len(uvs))):
        if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < below:
            raise FileFormatError(f"{path}: found {what} of {int(ids.max())}, expected numbers from 0 to {below - 1}")
    if not len(faces) or not 4 <= count <= _MOST_VERTICES or (len(expressions) and expressions.shape[1] != count):
        raise FileFormatError(f"{path}: found {count} vertices and {len(faces)} triangles, expected a head's")
    corners = uv_faces if len(uv_faces) == len(faces) else faces if len(uvs) == count else None
    mesh = Mesh(
        mean,
        torch.from_numpy(faces.astype(np.int64)),
        None if corners is None else torch.from_numpy(uvs * [1, -1] + [0, 1]).float(),
        None if corners is None else torch.from_numpy(corners.astype(np.int64)),
        colors=color.clamp(0, 1) if len(color) == count else None,
    )
    return HeadModelFile(
        NAME, mesh, identity, expressions, names, None, _places(landmarks, count), "as its authors say"
    )


def _places(landmarks: dict[str, int], count: int) -> SurfacePlaces | None:
    """Those whose names are iBUG's numbers, from 1."""
    ibug = {int(name) - 1: row for name, row in landmarks.items() if name.isdecimal() and 1 <= int(name) <= 68}
    if len(ibug) < 3 or not all(0 <= row < count for row in ibug.values()):
        return None
    return SurfacePlaces.at_vertices(ibug)


class _Archive:
    """The bytes of a file, read one value behind the other; no more is taken than there is."""

    def __init__(self, path: Path) -> None:
        self._path, self._data, self._at = path, read_file(path), 0

    def _taken(self, size: int, what: str) -> bytes:
        end = self._at + size
        if size < 0 or end > len(self._data):
            left = len(self._data) - self._at
            raise FileFormatError(f"{self._path}: found {left} bytes left (truncated?), expected {size} of {what}")
        piece, self._at = self._data[self._at : end], end
        return piece

    def integer(self, form: str) -> int:
        return int(struct.unpack(form, self._taken(struct.calcsize(form), "a number"))[0])

    def count(self, each: int) -> int:
        """How many follow, of at least ``each`` bytes."""
        count = self.integer("<Q")
        if count * each > len(self._data) - self._at:
            raise FileFormatError(f"{self._path}: found a list of {count} (truncated?), which the file cannot hold")
        return count

    def text(self) -> str:
        return self._taken(min(self.count(1), _LONGEST_NAME), "a name").decode("utf-8", errors="replace")

    def numbers(self, form: str, count: int) -> NDArray[np.float64]:
        values = np.frombuffer(self._taken(count * np.dtype(form).itemsize, "numbers"), form)
        if not np.isfinite(values).all() or (values.size and np.abs(values).max() > 1e9):
            raise FileFormatError(f"{self._path}: found NaN, infinity or a giant, expected finite numbers")
        return values

    def matrix(self) -> NDArray[np.float64]:
        """A matrix that lies column by column."""
        rows, columns = self.integer("<i"), self.integer("<i")
        if rows < 0 or columns < 0 or rows * columns > _MOST_NUMBERS:
            raise FileFormatError(f"{self._path}: found a matrix of {rows} by {columns}, expected a model's")
        return self.numbers("<f4", rows * columns).reshape(columns, rows).T

    def model(self) -> tuple[Tensor, Tensor, NDArray[np.float64]]:
        """A model's mean (V,3), what one standard deviation of each component adds (K,V,3), and triangles (F,3)."""
        mean, basis, variance = self.matrix(), self.matrix(), self.matrix()
        faces = self.numbers("<i4", self.count(12) * 3).reshape(-1, 3)
        if len(mean) % 3 or (basis.size and basis.shape != (len(mean), len(variance))):
            raise FileFormatError(
                f"{self._path}: found a basis of {basis.shape} beside {len(mean)} numbers and {len(variance)} variances"
            )
        if mean.size and np.abs(mean).max() > _LARGEST_NUMBER:
            raise FileFormatError(f"{self._path}: found a mean of {np.abs(mean).max():g}, expected millimetres")
        modes = basis * np.sqrt(np.maximum(variance[:, 0], 0)) if basis.size else np.zeros((len(mean), 0))
        shape = (modes.shape[1], len(mean) // 3, 3)
        places = torch.from_numpy(mean.reshape(-1, 3).astype(np.float32))
        return places, torch.from_numpy(np.ascontiguousarray(modes.T, dtype=np.float32)).reshape(shape), faces

    def expressions(self) -> tuple[Tensor, tuple[str, ...], Tensor]:
        """Blendshapes by name, or a model's components and its mean."""
        if self.integer("<i") == 1:  # of a variant of a model and blendshapes
            named = [(self.text(), self.matrix()) for _ in range(self.count(16))]
            rows = [torch.from_numpy(delta.reshape(-1, 3).astype(np.float32)) for _, delta in named]
            if len({len(row) for row in rows}) > 1:
                raise FileFormatError(f"{self._path}: found blendshapes of different sizes")
            return (
                torch.stack(rows or [torch.zeros(0, 3)])[: len(rows)],
                tuple(name for name, _ in named),
                torch.zeros(0),
            )
        offset, modes, _ = self.model()
        return modes, tuple(f"expression_{row:03}" for row in range(len(modes))), offset
