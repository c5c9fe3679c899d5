"""Characters of a few triangles, and their documents changed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rig_samples import named_sheet

from planted.glb_files import rewrite
from torchface import save_rig


def sheet(path: Path, names: tuple[str, ...]) -> Path:
    save_rig(named_sheet(names), path)
    return path


def edited(data: bytes, path: Path, edit: Callable[[dict[str, Any]], None]) -> Path:
    """A ``.glb`` with its document changed."""
    path.write_bytes(data)
    return rewrite(path, edit)
