"""A module's state as safetensors: the header is held against the module before any memory is taken."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.state_renames import current_state_keys

_LARGEST_HEADER = 2**20
_TYPES = {
    "F16": torch.float16,
    "F32": torch.float32,
    "F64": torch.float64,
    "I8": torch.int8,
    "I16": torch.int16,
    "I32": torch.int32,
    "I64": torch.int64,
    "U8": torch.uint8,
    "BOOL": torch.bool,
}


@dataclass(frozen=True)
class StoredTensor:
    """What a header says of one tensor."""

    dtype: torch.dtype
    shape: tuple[int, ...]

    @property
    def bytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


def pack_state(state: Mapping[str, Tensor], half: Collection[str] = ()) -> bytes:
    """The bytes of a state; integers take as few of them as their values allow.

    Args:
        state: finite tensors by name.
        half: names of float tensors that are stored in half precision.

    Raises:
        ValueRangeError: a tensor is NaN or infinite, also in half precision, or ``half`` names none of the state.
    """
    unknown = sorted(set(half) - set(state))
    if unknown:
        raise ValueRangeError(f"half: found {', '.join(unknown)}, expected names among {', '.join(state)}")
    packed = {}
    for name, tensor in state.items():
        stored = tensor.detach().cpu()
        if stored.is_floating_point():
            stored = stored.half() if name in half else stored
            if not bool(torch.isfinite(stored).all()):
                kind = "in half precision" if name in half else "in the state"
                raise ValueRangeError(f"{name}: found NaN or infinity {kind}, expected finite numbers")
        elif stored.dtype != torch.bool:
            stored = stored.to(_smallest(stored))
        packed[name] = stored.contiguous()
    return save(packed)


def read_state(
    path: Path, expected: Mapping[str, Tensor], size: int, kind: str = ""
) -> tuple[dict[str, Tensor], bytes]:
    """A state in the shapes and types of ``expected``, and the bytes it came from.

    Args:
        path: of the file.
        expected: the module's own state; tensors on the meta device will do.
        size: how many bytes the file should have.
        kind: of the model, for keys that were renamed; see ``state_renames``.

    Raises:
        FileFormatError: the file is cut off, is no safetensors file, holds other tensors than the module has, or NaN.
    """
    try:
        found = path.stat().st_size
        if found != size:
            raise FileFormatError(f"{path}: found {found} bytes, expected {size}: cut off, or of another model")
        with path.open("rb") as file:
            stored = _header(path, file.read(min(size, 8 + _LARGEST_HEADER)), size)
            names = current_state_keys(kind, stored, expected)
            _check(path, {names[key]: tensor for key, tensor in stored.items()}, expected)
            file.seek(0)
            data = file.read(size + 1)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        loaded = load(data)
    except (SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise FileFormatError(f"{path}: no readable state ({error})") from error
    state = {names[key]: tensor.to(expected[names[key]].dtype) for key, tensor in loaded.items()}
    for name, tensor in state.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise FileFormatError(f"{path}: found NaN or infinity in {name}, expected finite numbers")
    return state, data


def _smallest(values: Tensor) -> torch.dtype:
    for dtype in (torch.int8, torch.int16, torch.int32):
        limits = torch.iinfo(dtype)
        if values.numel() == 0 or (int(values.min()) >= limits.min and int(values.max()) <= limits.max):
            return dtype
    return torch.int64


def _header(path: Path, start: bytes, size: int) -> dict[str, StoredTensor]:
    """The tensors that a file says it holds; they fill it exactly."""
    length = int.from_bytes(start[:8], "little")
    if len(start) < 8 or length > min(_LARGEST_HEADER, size - 8):
        raise FileFormatError(f"{path}: no readable state (found a header of {length} bytes in {size})")
    try:
        document = json.loads(start[8 : 8 + length])
        tensors = {
            str(name): StoredTensor(_TYPES[entry["dtype"]], tuple(_count(n) for n in entry["shape"]))
            for name, entry in document.items()
            if name != "__metadata__"
        }
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FileFormatError(f"{path}: no readable state ({type(error).__name__}: {error})") from error
    claimed = sum(tensor.bytes for tensor in tensors.values())
    if claimed != size - 8 - length:
        raise FileFormatError(f"{path}: the header claims {claimed} bytes of numbers, found {size - 8 - length}")
    return tensors


def _count(number: object) -> int:
    if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < 2**48:
        raise ValueError(f"found {number!r} as a size")
    return number


def _check(path: Path, stored: Mapping[str, StoredTensor], expected: Mapping[str, Tensor]) -> None:
    if set(stored) != set(expected):
        odd = sorted(set(stored) ^ set(expected))
        raise FileFormatError(
            f"{path}: config and state do not fit (found {', '.join(sorted(stored)[:8])}; "
            f"expected {', '.join(sorted(expected)[:8])}; {', '.join(odd[:5])} in one of them only)"
        )
    for name, tensor in expected.items():
        found = stored[name]
        if found.shape != tuple(tensor.shape) or _family(found.dtype) != _family(tensor.dtype):
            raise FileFormatError(
                f"{path}: config and state do not fit ({name}: found {found.dtype} {found.shape}, "
                f"expected {tensor.dtype} {tuple(tensor.shape)})"
            )


def _family(dtype: torch.dtype) -> str:
    return "float" if dtype.is_floating_point else "bool" if dtype == torch.bool else "int"
