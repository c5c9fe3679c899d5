"""Folders of files that can be made again: graphs and pages, each made once."""

import os
import sys
from pathlib import Path

from torchface.files.whole_files import make_folder


def cache_folder(kind: str) -> Path:
    """The folder for cached files of one kind, made if it is missing; deleting it costs time alone.

    It lies in ``$TORCHFACE_CACHE`` if that is set, else where the system has a user's caches.
    """
    return make_folder(_root() / kind)


def _root() -> Path:
    if chosen := os.environ.get("TORCHFACE_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "torchface" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "torchface"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchface"
