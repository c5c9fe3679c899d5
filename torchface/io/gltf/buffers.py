"""The binary half of a glTF document under construction."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_LINEAR, _LINEAR_MIPMAPS = 9729, 9987
_COMPONENT = {"<u2": 5123, "<u4": 5125, "<f4": 5126}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class BufferWriter:
    """Collects arrays; each becomes a bufferView of its own, and an accessor where vertices or keys are meant."""

    def __init__(self) -> None:
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.pieces: list[bytes] = []
        self.size = 0
        self._still: dict[int, int] = {}

    def view(self, data: bytes, **fields: int) -> int:
        """The index of a bufferView of ``data``, which begins at a multiple of four."""
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": len(data), **fields})
        padded = data + b"\0" * (-len(data) % 4)
        self.pieces.append(padded)
        self.size += len(padded)
        return len(self.views) - 1

    def texture(self, root: dict[str, Any], image: bytes, kind: str = "image/png", name: str | None = None) -> int:
        """The index of a texture of an encoded image, which is added to a document under construction."""
        images, textures = root.setdefault("images", []), root.setdefault("textures", [])
        root.setdefault("samplers", [{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAPS}])
        named = {} if name is None else {"name": name}
        images.append({"bufferView": self.view(image), "mimeType": kind, **named})
        textures.append({"source": len(images) - 1, "sampler": 0})
        return len(textures) - 1

    def vertices(self, rows: NDArray[np.float32]) -> int:
        """An accessor of one row (D,) a vertex, with its bounds."""
        return self._accessor(rows, self.view(rows.astype("<f4").tobytes(), target=_ARRAY_BUFFER), bounds=True)

    def keys(self, rows: NDArray[np.float32], bounds: bool = False) -> int:
        """An accessor of an animation's times or values."""
        return self._accessor(rows, self.view(rows.astype("<f4").tobytes()), bounds)

    def triangles(self, faces: NDArray[np.int64]) -> int:
        """An accessor of a primitive's indices, of 16 bits where they suffice."""
        flat = faces.reshape(-1, 1)
        indices = flat.astype("<u2" if flat.max() < 65535 else "<u4")
        return self._accessor(indices, self.view(indices.tobytes(), target=_ELEMENT_BUFFER), bounds=False)

    def joints(self, rows: NDArray[np.float32]) -> int:
        """An accessor of four joints a vertex."""
        numbers = rows.astype("<u2")
        return self._accessor(numbers, self.view(numbers.tobytes(), target=_ARRAY_BUFFER), bounds=False)

    def deltas(self, rows: NDArray[np.float32]) -> int:
        """An accessor (C,3) of a morph target: the rows that move and their numbers, or all rows if that is smaller."""
        moved = np.flatnonzero((rows != 0).any(1))
        if len(moved) == 0 and len(rows) in self._still:
            return self._still[len(rows)]
        indices = moved.astype("<u2" if len(rows) <= 65535 else "<u4")
        if len(moved) * (12 + indices.itemsize) >= len(rows) * 12:
            return self.vertices(rows)
        sparse = {
            "count": len(moved),
            "indices": {"bufferView": 0, "componentType": _COMPONENT[indices.dtype.str]},
            "values": {"bufferView": 0},
        }
        accessor = self._accessor(rows, None, bounds=True)
        if len(moved) == 0:  # without data the accessor is all zeros, as wanted
            self._still[len(rows)] = accessor
        else:
            sparse["indices"]["bufferView"] = self.view(indices.tobytes())  # type: ignore[index]
            sparse["values"]["bufferView"] = self.view(rows[moved].astype("<f4").tobytes())  # type: ignore[index]
            self.accessors[accessor]["sparse"] = sparse
        return accessor

    def _accessor(self, rows: NDArray[Any], view: int | None, bounds: bool) -> int:
        rows = rows.reshape(len(rows), -1)
        accessor: dict[str, Any] = {} if view is None else {"bufferView": view}
        accessor |= {"componentType": _COMPONENT[rows.dtype.str], "count": len(rows), "type": _TYPES[rows.shape[1]]}
        if bounds:
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1
