"""Accessors as arrays: strided, normalised, sparse."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchface.io.gltf.gltf_document import Document, shown

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_INDEX_COMPONENTS = (5121, 5123, 5125)


def read_indices(document: Document, index: object, where: str) -> NDArray[np.int64]:
    """The integers (C,) of a primitive's ``indices``."""
    accessor = document.item("accessors", index, where)
    if accessor.get("componentType") not in _INDEX_COMPONENTS:
        raise document.error(where, shown(accessor.get("componentType")), "unsigned integers (5121, 5123 or 5125)")
    return _read(document, accessor, index, ("SCALAR",), None)[:, 0].astype(np.int64)


def read_floats(
    document: Document, index: object, where: str, types: tuple[str, ...], count: int | None = None
) -> NDArray[np.float32]:
    """Rows (C,D) of an attribute of one of these ``types``; integers are normalised where the accessor says so."""
    accessor = document.item("accessors", index, where)
    rows = _read(document, accessor, index, types, count)
    kind, result = rows.dtype, rows.astype(np.float32)
    if accessor.get("normalized") is True and kind.kind in "iu":
        result = np.maximum(result / np.float32(np.iinfo(kind).max), np.float32(-1))
    if not np.isfinite(result).all():
        bad = int((~np.isfinite(result)).any(1).sum())
        raise document.error(where, f"NaN or infinity in {bad} of {len(result)} rows", "finite numbers")
    return result


def _read(
    document: Document, accessor: dict[str, Any], index: object, types: tuple[str, ...], expected: int | None
) -> NDArray[Any]:
    location = f"accessors[{index}]"
    component, kind = accessor.get("componentType"), accessor.get("type")
    if not isinstance(component, int) or component not in _COMPONENTS:
        raise document.error(
            f"{location}.componentType", shown(component), f"one of {', '.join(map(str, _COMPONENTS))}"
        )
    if not isinstance(kind, str) or kind not in types:
        raise document.error(f"{location}.type", shown(kind), " or ".join(types))
    count = document.integer(accessor, "count", location)
    if expected is not None and count != expected:
        raise document.error(f"{location}.count", count, f"{expected}, as the primitive's other attributes")
    dtype, width = np.dtype(_COMPONENTS[component]), _WIDTHS[kind]
    document.reserve(count * width * 4, f"{location}.count")
    if isinstance(index, int) and index in document.unpacked_accessors:
        rows = document.unpacked_accessors[index]
        if rows.shape != (count, width):
            raise document.error(location, f"{rows.shape} numbers that Draco unpacks", f"{(count, width)}")
    elif accessor.get("bufferView") is None:
        rows = np.zeros((count, width), dtype)
    else:
        view, stride = document.view(accessor["bufferView"], f"{location}.bufferView")
        offset = document.integer(accessor, "byteOffset", location, 0)
        rows = _rows(document, location, view, offset, stride, count, width, dtype)
    sparse = accessor.get("sparse")
    return rows if sparse is None else _replace(document, document.record(sparse, location), location, rows)


def _rows(
    document: Document,
    location: str,
    view: memoryview,
    offset: int,
    stride: int | None,
    count: int,
    width: int,
    dtype: np.dtype[Any],
) -> NDArray[Any]:
    size = width * dtype.itemsize
    stride = size if stride is None else stride
    if stride < size:
        raise document.error(f"{location}: byteStride", stride, f"at least the {size} bytes of an element")
    last = offset + (count - 1) * stride + size if count else offset
    if last > len(view):
        raise document.error(
            location, f"{count} elements up to byte {last}", f"at most the {len(view)} bytes there are"
        )
    if count == 0:
        return np.zeros((0, width), dtype)
    return np.ndarray((count, width), dtype, buffer=view, offset=offset, strides=(stride, dtype.itemsize))


def _replace(document: Document, sparse: dict[str, Any], location: str, rows: NDArray[Any]) -> NDArray[Any]:
    """The rows with those replaced that a sparse accessor names."""
    location += ".sparse"
    count = document.integer(sparse, "count", location)
    if count > len(rows):
        raise document.error(f"{location}.count", count, f"at most {len(rows)}")
    indices = document.record(sparse.get("indices"), f"{location}.indices")
    values = document.record(sparse.get("values"), f"{location}.values")
    component = indices.get("componentType")
    if component not in _INDEX_COMPONENTS:
        raise document.error(f"{location}.indices.componentType", shown(component), "5121, 5123 or 5125")
    view, _ = document.view(indices.get("bufferView"), f"{location}.indices.bufferView")
    offset = document.integer(indices, "byteOffset", f"{location}.indices", 0)
    where = _rows(document, f"{location}.indices", view, offset, None, count, 1, np.dtype(_COMPONENTS[component]))[:, 0]
    if count and int(where.max()) >= len(rows):
        raise document.error(f"{location}.indices", int(where.max()), f"less than {len(rows)}")
    view, _ = document.view(values.get("bufferView"), f"{location}.values.bufferView")
    offset = document.integer(values, "byteOffset", f"{location}.values", 0)
    replaced = rows.copy()
    replaced[where] = _rows(document, f"{location}.values", view, offset, None, count, rows.shape[1], rows.dtype)
    return replaced
