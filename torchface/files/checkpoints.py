"""What unfinished work has done so far, on disk: tensors in one safetensors file that names what they belong to."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import load, save
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file, write_file


def write_checkpoint(path: Path, tensors: Mapping[str, Tensor], belongs_to: Mapping[str, str]) -> None:
    """Writes tensors and what they belong to; the file appears only when it is complete.

    Args:
        path: of the file; its folder must be there.
        tensors: by name.
        belongs_to: whatever the tensors depend on, as texts.

    Raises:
        FileFormatError: the file cannot be written.
    """
    packed = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_file(path, save(packed, dict(belongs_to)))


def read_checkpoint(path: Path, belongs_to: Mapping[str, str]) -> dict[str, Tensor] | None:
    """The tensors of a checkpoint; None where there is none, it is damaged or belongs to something else."""
    try:
        with safe_open(path, framework="pt") as file:
            if file.metadata() != dict(belongs_to):
                return None
        return load(read_file(path))
    except (SafetensorError, OSError, ValueError, KeyError, RuntimeError, FileFormatError):
        return None  # what is damaged is computed again
