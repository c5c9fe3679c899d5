"""Folders of models by name, and the models that can be loaded."""

import os
import warnings
from functools import cache
from pathlib import Path

from torchface.errors import FileFormatError, NameMismatchError
from torchface.files.model_roots import is_folder, is_model, model_names, model_roots
from torchface.files.models import DESCRIPTION, model_fault
from torchface.zoo.hub import fetch_model, hub_reference
from torchface.zoo.kinds import KINDS

HOME = "TORCHFACE_HOME"
"""The environment variable that names a folder of further models."""


def list_models() -> list[str]:
    """Names of the models that can be loaded, sorted; damaged ones are left out with a warning that says why.

    Example:
        >>> {"head", "landmark_network", "marker_solver"} <= set(list_models())
        True
    """
    damaged = damaged_models()
    for name, fault in damaged.items():
        _warn_once(f"model {name!r} is left out: {fault}")
    return sorted(all_names() - set(damaged))


def damaged_models() -> dict[str, str]:
    """Models that cannot be loaded, by name, and why: as far as description, kind and the state's size show.

    Example:
        >>> damaged_models()
        {}
    """
    faults = {name: model_fault(named_folders(name)[0], KINDS) for name in sorted(all_names())}
    return {name: fault for name, fault in faults.items() if fault is not None}


def find(name_or_path: str | Path) -> Path:
    """The folder of a model; see :func:`get_model`. A name that several folders have gets a warning, once.

    Example:
        >>> sorted(path.name for path in find("head").iterdir())
        ['CARD.md', 'model.toml', 'state.safetensors']
    """
    given = str(name_or_path)
    if reference := hub_reference(given):
        return fetch_model(reference)
    if is_path(name_or_path):
        folder = Path(given)
        if not is_folder(folder):
            raise FileFormatError(f"{given!r}: found no such folder, expected one with {DESCRIPTION}")
        return folder
    named = named_folders(given)
    if named:
        if named[1:]:
            others = ", ".join(str(folder.resolve()) for folder in named[1:])
            _warn_once(
                f"model {given!r}: {named[0]} goes before {others}; for another one name its folder by a path, "
                f"such as {named[1].resolve()}"
            )
        return named[0]
    why = f" (the folder of that name holds no {DESCRIPTION})" if is_folder(Path(given or os.devnull)) else ""
    known = ", ".join(list_models()) or "none at all"
    home = os.environ.get(HOME)
    missing = f"; ${HOME} is {home!r}, which is no folder" if home and not is_folder(Path(home)) else ""
    trained = f" (there is {Path('models') / given}: name it so)" if is_model(Path("models"), given) else ""
    raise NameMismatchError(
        f"model: found no {given[:80]!r}{why}, expected one of {known}; or the path of a model's folder{trained}, "
        f"which goes by its name if it lies in ${HOME}{missing}"
    )


def is_path(name_or_path: str | Path) -> bool:
    given = str(name_or_path)
    return isinstance(name_or_path, Path) or "/" in given or os.sep in given


def _roots() -> list[Path]:
    return model_roots(Path(__file__).resolve().parents[1], os.environ.get(HOME))


def all_names() -> set[str]:
    """Of the models of every root, damaged ones among them; a root that cannot be listed is named in a warning."""
    names: set[str] = set()
    for root in _roots():
        try:
            names.update(model_names(root))
        except OSError as error:
            _warn_once(f"models: {root} cannot be listed ({error.strerror})")
    return names


def named_folders(name: str) -> list[Path]:
    """Folders of models of this name, the winner first: those of the roots, then that in the working directory."""
    folders = [root / name for root in _roots() if is_model(root, name)]
    local = Path(name or os.devnull)
    try:
        if (local / DESCRIPTION).is_file() and local.resolve() not in [folder.resolve() for folder in folders]:
            folders.append(local)
    except (OSError, ValueError):  # a name that is too long for a file, a NUL
        pass
    return folders


@cache
def _warn_once(message: str) -> None:
    warnings.warn(message, stacklevel=3)
