"""The Basel Face Model, 2017 and 2019, and other models of Statismo's layout: HDF5, by h5py (extra ``hdf5``).

Source: University of Basel's scalismo-faces, whose reader names the groups; Gerig et al. 2018.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.extra_packages import import_extra
from torchface.files.input_files import note_read
from torchface.io.head_models.array_files import LARGEST_ARRAYS
from torchface.io.head_models.head_model_file import HeadModelFile, SurfacePlaces
from torchface.mesh import Mesh

NAME = "Basel Face Model"
SIGNATURE = b"\x89HDF\r\n\x1a\n"
_LANDMARKS = "metadata/landmarks/json"
_MAX_TEXT, _MOST_VERTICES, _LARGEST_NUMBER = 2**20, 2**20, 1e6
# The names of its landmarks that are iBUG's too, and their rows.
_IBUG = {
    "center.chin.tip": 8,
    "center.nose.tip": 30,
    "right.eye.corner_outer": 36,
    "right.eye.corner_inner": 39,
    "left.eye.corner_inner": 42,
    "left.eye.corner_outer": 45,
    "right.lips.corner": 48,
    "center.lips.upper.outer": 51,
    "left.lips.corner": 54,
    "center.lips.lower.outer": 57,
    "center.lips.upper.inner": 62,
    "center.lips.lower.inner": 66,
}


def is_hdf5(path: Path) -> bool:
    """Whether a file begins as HDF5 does."""
    with path.open("rb") as file:
        return file.read(8) == SIGNATURE


def read_basel(path: Path) -> HeadModelFile:
    """Reads shape, expression and colour."""
    h5py = import_extra("h5py", "h5py", "hdf5", f"{path.name}, a file of HDF5,")
    note_read(path)
    try:
        with h5py.File(path, "r") as file:
            return _model(path, _Sets(path, file, h5py))
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        raise FileFormatError(f"{path}: no readable HDF5 ({error})") from error


class _Sets:
    """Data sets of a file, looked at before they are read: no links to other files, no memory beyond the budget."""

    def __init__(self, path: Path, file: Any, h5py: Any) -> None:
        self._path, self._file, self._h5py, self._left = path, file, h5py, LARGEST_ARRAYS

    def found(self, name: str) -> Any | None:
        """A data set that is there in this file itself."""
        group, parts = self._file, name.split("/")
        for number, part in enumerate(parts):
            if not isinstance(group, self._h5py.Group) or part not in group:
                return None
            if not isinstance(group.get(part, getlink=True), self._h5py.HardLink):
                raise FileFormatError(f"{self._path}: found a link in place of {'/'.join(parts[: number + 1])}")
            group = group[part]
        if not isinstance(group, self._h5py.Dataset) or group.is_virtual or group.external:
            raise FileFormatError(f"{self._path}: found {name} that lies in another file, expected numbers in this one")
        return group

    def numbers(self, name: str, *shape: int | None) -> Tensor:
        """A data set of real numbers, float32."""
        wanted = ",".join("*" if size is None else str(size) for size in shape)
        stored = self.found(name)
        sizes = () if stored is None else tuple(stored.shape)
        fits = len(sizes) == len(shape) and all(e is None or e == f for e, f in zip(shape, sizes, strict=True))
        if stored is None or not fits or stored.dtype.kind not in "fiu":
            what = "none" if stored is None else f"{stored.dtype} {list(sizes)}"
            raise FileFormatError(f"{self._path}: found {what} at {name}, expected ({wanted}) numbers")
        size = int(np.prod(sizes, dtype=object)) * stored.dtype.itemsize
        if size > self._left:
            raise FileFormatError(f"{self._path}: found {name} of {size} bytes, expected at most {self._left} in all")
        self._left -= size
        with np.errstate(over="ignore"):
            values = np.asarray(stored[()], dtype=np.float32)
        if not bool(np.isfinite(values).all()) or (values.size and float(np.abs(values).max()) > 1e9):
            raise FileFormatError(f"{self._path}: found NaN, infinity or a giant in {name}, expected finite numbers")
        return torch.from_numpy(values)

    def text(self, name: str) -> str:
        """A data set of one text or of its bytes; empty where there is none."""
        stored = self.found(name)
        if stored is None or int(np.prod(stored.shape, dtype=object)) * stored.dtype.itemsize > _MAX_TEXT:
            return ""
        value = stored[()]
        raw = value if isinstance(value, bytes) else np.asarray(value).tobytes()
        return raw[:_MAX_TEXT].decode("utf-8", errors="replace")


def _model(path: Path, sets: _Sets) -> HeadModelFile:
    mean = sets.numbers("shape/model/mean", None)
    if len(mean) % 3 or not 12 <= len(mean) < 3 * _MOST_VERTICES or float(mean.abs().max()) > _LARGEST_NUMBER:
        raise FileFormatError(f"{path}: found a mean of {len(mean)} numbers, expected 3 for each of some vertices")
    count = len(mean) // 3
    identity, _ = _modes(sets, "shape", count)
    expressions = torch.zeros(0, count, 3)
    if sets.found("expression/model/mean") is not None:
        expressions, offset = _modes(sets, "expression", count)
        mean = mean + offset
    cells = sets.numbers("shape/representer/cells", 3, None).T
    faces = cells.round().long()
    if not len(faces) or int(faces.min()) < 0 or int(faces.max()) >= count or not torch.equal(faces.float(), cells):
        raise FileFormatError(f"{path}: found triangles of vertices beyond the {count} there are")
    colors = None
    if sets.found("color/model/mean") is not None:
        colors = sets.numbers("color/model/mean", 3 * count).reshape(count, 3)
        colors = (colors / (255.0 if float(colors.max()) > 1.5 else 1.0)).clamp(0, 1)
    vertices = mean.reshape(count, 3)
    mesh = Mesh(vertices, faces.contiguous(), colors=colors)
    names = tuple(f"expression_{i:03}" for i in range(len(expressions)))
    landmarks = _landmarks(path, sets.text(_LANDMARKS), vertices)
    return HeadModelFile(
        NAME, mesh, identity, expressions, names, None, landmarks, "research alone, as its authors say"
    )


def _modes(sets: _Sets, kind: str, count: int) -> tuple[Tensor, Tensor]:
    """What one standard deviation of each component adds, (K,V,3), and the mean (3V,)."""
    basis = sets.numbers(f"{kind}/model/pcaBasis", 3 * count, None)
    variance = sets.numbers(f"{kind}/model/pcaVariance", basis.shape[1])
    modes = (basis * variance.clamp(min=0).sqrt()).T.reshape(-1, count, 3).contiguous()
    return modes, sets.numbers(f"{kind}/model/mean", 3 * count)


def _landmarks(path: Path, text: str, vertices: Tensor) -> SurfacePlaces | None:
    """Those that the file has places for: a table of names, or a list of entries with ``id`` and ``coordinates``."""
    if not text.strip("\0 \n"):
        return None
    try:
        document = json.loads(text.strip("\0 \n"))
        if isinstance(document, list):
            document = {entry["id"]: entry["coordinates"] for entry in document}
        named = {row: document[name] for name, row in _IBUG.items() if name in document}
        places = torch.tensor(list(named.values()), dtype=torch.float64).reshape(-1, 3)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FileFormatError(f"{path}: found landmarks that are no names with places ({error})") from error
    if len(places) < 3 or not bool(torch.isfinite(places).all()):
        return None
    nearest = cKDTree(vertices.double().numpy()).query(places.numpy())[1]
    return SurfacePlaces.at_vertices(dict(zip(named, nearest.tolist(), strict=True)))
