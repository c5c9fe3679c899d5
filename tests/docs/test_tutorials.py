"""The tutorials' code compiles, and what it takes of torchface is there and public; `make docs` runs it."""

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

TUTORIALS = Path(__file__).resolve().parents[2] / "docs" / "tutorials"
PAGES = sorted(TUTORIALS.glob("[0-9]*.md"))


def code(page: Path) -> ast.Module:
    """The page's cells as one program."""
    cells = re.findall(
        r"^```\{code-cell\}[^\n]*\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
    return ast.parse("\n".join(cells), filename=page.name)


def taken(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Module and name of whatever a program takes of torchface."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "torchface":
            yield from ((str(node.module), alias.name) for alias in node.names)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "torchface":
            yield "torchface", node.attr


def is_public(module: str, name: str) -> bool:
    """A module's ``__all__`` names it, or it is a public module."""
    home = importlib.import_module(module)
    if name in getattr(home, "__all__", ()):
        return hasattr(home, name)
    try:
        return hasattr(importlib.import_module(f"{module}.{name}"), "__all__")
    except ModuleNotFoundError:
        return False


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_tutorial_compiles_and_takes_public_names_alone(page: Path) -> None:
    tree = code(page)
    assert tree.body
    names = set(taken(tree))
    assert names
    assert sorted(f"{module}.{name}" for module, name in names if not is_public(module, name)) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_tutorial_is_a_notebook_that_ends_in_a_picture_and_says_what_can_go_wrong(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert text.startswith("---\nfile_format: mystnb\n")
    assert "**You need**" in text
    assert [line for line in text.splitlines() if line.startswith("## ")][-2:] == [
        "## What can go wrong",
        "## Your own data",
    ]
    assert "to_pillow(" in text.partition("## What can go wrong")[0].rpartition("```{code-cell}")[2]
