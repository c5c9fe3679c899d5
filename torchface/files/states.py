"""A module's state as safetensors: the header is held against the module before any memory is taken."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load, save
from torch import Tensor

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.state_renames import current_state_keys

MAX_HEADER_BYTES = 2**20
_FAMILIES = {
    **dict.fromkeys(("F16", "F32", "F64"), "float"),
    **dict.fromkeys(("I8", "I16", "I32", "I64", "U8"), "int"),
    "BOOL": "bool",
}
"""Which types of a file fit which of a module: the width of a number may differ."""


def pack_state(state: Mapping[str, Tensor], half: Collection[str] = ()) -> bytes:
    """The bytes of a state; integers take as few of them as their values allow.

    Args:
        state: finite tensors by name.
        half: names of float tensors that are stored in half precision.
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
        expected: the module's own state; tensors on the meta device will do.
        size: how many bytes the file should have.
        kind: of the model, for keys that were renamed; see ``state_renames``.
    """
    try:
        check_size(path, size)
        with path.open("rb") as file:
            if int.from_bytes(file.read(8), "little") > MAX_HEADER_BYTES:
                raise FileFormatError(f"{path}: no readable state (found a header above {MAX_HEADER_BYTES} bytes)")
            with safe_open(path, framework="pt") as stored:  # reads and checks the header alone
                names = current_state_keys(kind, stored.keys(), expected)
                _check(path, {names[key]: stored.get_slice(key) for key in stored.keys()}, expected)  # noqa: SIM118
            file.seek(0)
            data = file.read(size + 1)
        loaded = load(data)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror})") from error
    except (SafetensorError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise FileFormatError(f"{path}: no readable state ({error})") from error
    state = {names[key]: tensor.to(expected[names[key]].dtype) for key, tensor in loaded.items()}
    for name, tensor in state.items():
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise FileFormatError(f"{path}: found NaN or infinity in {name}, expected finite numbers")
    return state, data


def check_size(path: Path, size: int) -> None:
    """Refuses a state that has not as many bytes as its description says."""
    bytes_there = path.stat().st_size
    if bytes_there != size:
        raise FileFormatError(f"{path}: found {bytes_there} bytes, expected {size}: cut off, or of another model")


def _smallest(values: Tensor) -> torch.dtype:
    for dtype in (torch.int8, torch.int16, torch.int32):
        limits = torch.iinfo(dtype)
        if values.numel() == 0 or (int(values.min()) >= limits.min and int(values.max()) <= limits.max):
            return dtype
    return torch.int64


def _check(path: Path, stored: Mapping[str, Any], expected: Mapping[str, Tensor]) -> None:
    if set(stored) != set(expected):
        odd = sorted(set(stored) ^ set(expected))
        raise FileFormatError(
            f"{path}: config and state do not fit (found {', '.join(sorted(stored)[:8])}; "
            f"expected {', '.join(sorted(expected)[:8])}; {', '.join(odd[:5])} in one of them only)"
        )
    for name, tensor in expected.items():
        dtype, shape = stored[name].get_dtype(), tuple(stored[name].get_shape())
        if shape != tuple(tensor.shape) or _FAMILIES.get(dtype) != _family(tensor.dtype):
            raise FileFormatError(
                f"{path}: config and state do not fit ({name}: found {dtype} {shape[:8]}, "
                f"expected {tensor.dtype} {tuple(tensor.shape)})"
            )


def _family(dtype: torch.dtype) -> str:
    return "float" if dtype.is_floating_point else "bool" if dtype == torch.bool else "int"
