"""Checkpoints of unfinished work: tensors in one safetensors file that names what they were made of."""

import warnings
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import load, save
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.content_keys import content_key
from torchface.files.whole_files import read_file, write_file

_FORMAT = "torchface.checkpoint/1"


def write_checkpoint(path: Path, tensors: Mapping[str, Tensor], key: str) -> None:
    """Writes tensors, the content key of what they were made of, and a hash of their numbers; the file appears only
    when it is complete, in a folder that is there."""
    packed = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_file(path, save(packed, {"format": _FORMAT, "key": key, "content": _content(packed)}))


def read_checkpoint(path: Path, key: str) -> dict[str, Tensor] | None:
    """The tensors of a checkpoint; None where there is none, or it was made of something else.

    One that is damaged, be it a single number, is named in a warning and taken for none: its part is computed again.
    """
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
        if (metadata.get("format"), metadata.get("key")) != (_FORMAT, key):
            return None
        tensors = load(read_file(path))
        if _content(tensors) == metadata.get("content"):
            return tensors
        fault = "its numbers are not those that were written"
    except (SafetensorError, OSError, ValueError, KeyError, RuntimeError, FileFormatError) as error:
        fault = str(error)
    warnings.warn(f"{path}: found a damaged checkpoint ({fault}); what it held is computed again", stacklevel=2)
    return None


def checkpoint_key(path: Path) -> str | None:
    """The key that a checkpoint was written with; None where there is none, or it cannot be read."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
        return metadata.get("key")
    except (SafetensorError, OSError, ValueError):
        return None


def _content(tensors: Mapping[str, Tensor]) -> str:
    return content_key(_FORMAT, tensors={name: tensors[name] for name in sorted(tensors)})
