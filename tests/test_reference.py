"""Every public name stands in the reference, and every error has its causes and cures.

Public is what an ``__all__`` names.
"""

from __future__ import annotations

import importlib
import inspect
import re
from functools import cache
from pathlib import Path
from typing import Any

import torchface
from torchface import errors

LIBRARY = Path(torchface.__file__).resolve().parent
DOCS = Path(__file__).resolve().parents[1] / "docs"


@cache
def public_names() -> dict[str, Any]:
    """What each public path leads to."""
    found = {}
    for path in sorted(LIBRARY.rglob("*.py")):
        if "\n__all__ = " in path.read_text(encoding="utf-8"):
            parts = ("torchface", *path.relative_to(LIBRARY).with_suffix("").parts)
            module = importlib.import_module(".".join(parts).removesuffix(".__init__"))
            found.update({f"{module.__name__}.{name}": getattr(module, name) for name in module.__all__})
    return found


def resolved(path: str) -> Any:
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


def key(path: str, thing: Any) -> object:
    """Equal for two ways to one thing; a plain value is itself only under its own path."""
    return path if isinstance(thing, str | float) else id(thing)


def test_every_public_name_stands_in_the_reference_once() -> None:
    wanted = {key(path, thing): path for path, thing in public_names().items()}
    text = "\n".join(page.read_text(encoding="utf-8") for page in sorted((DOCS / "reference").glob("*.md")))
    listed = re.findall(r"^\.\. (?:auto\w+|py:data):: (\S+)$", text, re.MULTILINE)
    keys = [key(path, resolved(path)) for path in listed]
    assert sorted({path for path, one in zip(listed, keys, strict=True) if keys.count(one) > 1}) == []
    assert sorted(path for one, path in wanted.items() if one not in keys) == []
    assert sorted(path for path, one in zip(listed, keys, strict=True) if one not in wanted) == []


def test_every_error_has_its_causes_and_cures() -> None:
    text = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    headings = re.findall(r"^#+ `(\w+)`$", text, re.MULTILINE)
    classes = [*errors.__all__, *(thing.__name__ for thing in public_names().values() if is_error(thing))]
    assert sorted(set(classes) - {"TorchfaceError"} - set(headings)) == []


def is_error(thing: Any) -> bool:
    return inspect.isclass(thing) and issubclass(thing, errors.TorchfaceError)
