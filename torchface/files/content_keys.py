"""Keys of what results were made of: a run takes up an earlier run's results only where their keys are the same."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path

import torch
from torch import Tensor, nn

from torchface import __version__
from torchface.errors import FileFormatError

_BLOCK = 2**22


def content_key(method: str, **inputs: object) -> str:
    """Sixty-four hex digits, others where the method, this package's version or the content of any input differs.

    Args:
        method: its name and a number that is raised whenever the same inputs come to give other results.
        inputs: everything the results depend on: tensors, texts, numbers, dataclasses and modules of these, mappings
            and sequences. A ``Path`` stands for what lies there: a file's bytes, a folder's files with their names,
            those that are hidden left out; nothing that can be read is a content of its own.
    """
    digest = hashlib.sha256()
    for part in (method, __version__, inputs):
        _add(digest, part)
    return digest.hexdigest()


def file_digest(path: str | Path) -> str:
    """The SHA-256 of a file's bytes, read a block at a time."""
    digest = hashlib.sha256()
    try:
        with Path(path).open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror})") from error
    return digest.hexdigest()


def _add(digest: "hashlib._Hash", value: object) -> None:
    """Adds a value with its kind and its length, so that no two different ones read the same."""
    if value is None or isinstance(value, str | bool | int | float):
        _add_text(digest, f"{type(value).__name__} {value!r}")
    elif isinstance(value, Enum):
        _add_text(digest, f"{type(value).__qualname__} {value.name}")
    elif isinstance(value, Tensor):
        tensor = value.detach().cpu().contiguous()
        _add_text(digest, f"tensor {tensor.dtype} {tuple(tensor.shape)}")
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    elif isinstance(value, Path):
        _add_path(digest, value)
    elif isinstance(value, nn.Module):
        _add_text(digest, f"module {type(value).__qualname__}")
        _add(digest, [getattr(value, "config", None), value.state_dict()])
    elif is_dataclass(value) and not isinstance(value, type):
        _add_text(digest, f"dataclass {type(value).__qualname__}")
        _add(digest, {field.name: getattr(value, field.name) for field in fields(value)})
    elif isinstance(value, Mapping):
        _add_text(digest, f"mapping {len(value)}")
        for name, item in value.items():
            _add(digest, name)
            _add(digest, item)
    elif isinstance(value, Sequence):
        _add_text(digest, f"sequence {len(value)}")
        for item in value:
            _add(digest, item)
    else:
        raise TypeError(f"found a {type(value).__qualname__}, expected what has a content of numbers and texts")


def _add_path(digest: "hashlib._Hash", path: Path) -> None:
    if path.is_dir():
        inside = sorted(file for file in path.rglob("*") if file.is_file())
        names = [file.relative_to(path).as_posix() for file in inside]
        listed = [number for number, name in enumerate(names) if not any(part[0] == "." for part in name.split("/"))]
        _add_text(digest, f"folder {len(listed)}")
        for number in listed:
            _add_text(digest, names[number])
            _add_path(digest, inside[number])
        return
    try:
        _add_text(digest, f"file {file_digest(path)}")
    except FileFormatError:
        _add_text(digest, "nothing that can be read")


def _add_text(digest: "hashlib._Hash", text: str) -> None:
    data = text.encode("utf-8", "surrogatepass")
    digest.update(len(data).to_bytes(8, "little") + data)
