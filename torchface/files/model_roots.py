"""Folders of models: the checkout's, the installed package's, the user's; of models of one name the first wins."""

import re
from functools import cache
from pathlib import Path

from torchface.errors import FileFormatError, NameMismatchError, TorchfaceError
from torchface.files.documents import read_toml
from torchface.files.models import DESCRIPTION

MODEL_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


def check_model_name(folder: Path) -> None:
    """Raises ``NameMismatchError`` where a folder's name is none for a model."""
    if not MODEL_NAME.fullmatch(folder.name):
        raise NameMismatchError(
            f"{folder}: found the name {folder.name!r}, expected letters from a to z, digits, - and _, at most 64, the "
            "first a letter or digit"
        )


def model_roots(package: Path, home: str | None) -> list[Path]:
    """Folders of models that are there, each once: the checkout's, the installed package's, the user's own ``home``."""
    checkout = package.parent
    wanted = [checkout / "models"] if is_checkout(checkout, package.name) else []
    wanted += [package / "_models", *([Path(home)] if home else [])]
    return list({root.resolve(): root for root in reversed(wanted) if is_folder(root)}.values())[::-1]


def shipped_model(name: str) -> Path:
    """The folder of a model that comes with torchface."""
    package = Path(__file__).resolve().parents[1]
    for root in model_roots(package, None):
        if is_model(root, name):
            return root / name
    raise FileFormatError(f"{package.parent / 'models' / name}: found no such folder, expected the shipped model")


def is_checkout(folder: Path, package: str) -> bool:
    """Whether a folder is the package's own checkout, and not what some other project left where it is installed.

    Its ``pyproject.toml`` must be the package's own, and no installer may have put the package there: what it installs
    it records beside.
    """
    path = folder / "pyproject.toml"
    try:
        project = _project(path, path.stat().st_mtime_ns)
    except (TorchfaceError, OSError, ValueError):  # none, a stranger's without a name, no TOML
        return False
    return project == package and not any(folder.glob(f"{package}-*.dist-info"))


@cache
def _project(path: Path, _changed: int) -> str:
    """The name that a project's file gives it; each model that is looked up asks for it."""
    return read_toml(path)["project"]["name"].text()


def is_model(root: Path, name: str) -> bool:
    """Whether a root holds a folder of this name with a description; a link that leads out of the root is none."""
    if not MODEL_NAME.fullmatch(name):
        return False
    folder = root / name
    try:
        return folder.resolve().is_relative_to(root.resolve()) and (folder / DESCRIPTION).is_file()
    except (OSError, RuntimeError):  # a loop of links
        return False


def model_names(root: Path) -> list[str]:
    """Names of the models that a root holds, sorted, damaged ones among them."""
    return sorted(entry.name for entry in root.iterdir() if is_model(root, entry.name))


def is_folder(path: Path) -> bool:
    """Whether a path leads to a folder; one that cannot be followed does not."""
    try:
        return path.is_dir()
    except (OSError, ValueError):  # above it is what this user may not enter; a name too long; a NUL
        return False
