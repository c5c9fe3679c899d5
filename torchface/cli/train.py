"""``torchface train``: the recipes that make learned models, looked up by name: the library does not know them."""

import ast
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

from rich.table import Table
from rich.text import Text

from torchface.cli.terminal import PlainConsole
from torchface.errors import FileFormatError, NameMismatchError

_PACKAGE = Path(__file__).resolve().parents[1]
_INSTALLED, _IN_CHECKOUT = "torchface._train", "train"
_MARK = "``torchface train "  # begins a recipe's docstring; behind it the name, flags, and what it makes


def train(words: Sequence[str]) -> None:
    """Learn a model of your own by a recipe: `torchface train --help`.

    Raises:
        NameMismatchError: no recipe has this name.
        FileFormatError: a file is no recipe, or the recipes are not there.
    """
    package = recipes_package()
    recipes = summaries(package)
    if not words or words[0] in ("--help", "-h"):
        _overview(recipes)
        raise SystemExit(0 if words else 2)
    name, *flags = words
    if name.endswith(".py"):
        module = _loaded(Path(name), package)
    elif (known := name.replace("-", "_")) in recipes:
        module = import_module(f"{package.__name__}.{known}")
    else:
        raise NameMismatchError(
            f"train: found the recipe {name!r}, expected one of {', '.join(recipes)}, or a .py file"
        )
    module.RECIPE.main(flags)


def recipes_package() -> ModuleType:
    """The package of the recipes: the wheel's, or the one beside torchface in a checkout.

    Raises:
        FileFormatError: there is none, or another package of that name was found first.
    """
    from torchface.files.model_roots import is_checkout  # brings torch

    if find_spec(_INSTALLED) is not None:
        return import_module(_INSTALLED)
    checkout = _PACKAGE.parent
    folder = checkout / _IN_CHECKOUT
    if not (is_checkout(checkout, _PACKAGE.name) and folder.is_dir()):
        raise FileFormatError(f"{_PACKAGE / '_train'}: found no recipes, expected those that come with torchface")
    if str(checkout) not in sys.path:
        sys.path.append(str(checkout))  # processes that recipes start find it there
    package = import_module(_IN_CHECKOUT)
    if Path(package.__file__ or "").resolve().parent != folder:
        raise FileFormatError(f"{package.__file__}: found another package 'train', expected {folder}")
    return package


def summaries(package: ModuleType) -> dict[str, str]:
    """What each recipe makes, by name, read off its file without running it."""
    first_lines = {}
    for path in sorted(Path(package.__file__ or "").parent.glob("*.py")):
        docstring = (ast.get_docstring(ast.parse(path.read_bytes())) or "").partition("\n\n")[0]
        if docstring.startswith(_MARK):
            first_lines[path.stem] = " ".join(docstring.partition("``: ")[2].split()).rstrip(".")
    return first_lines


def _loaded(path: Path, package: ModuleType) -> ModuleType:
    """A recipe of the user's own, as if it lay beside the others: ``from .runner import Recipe`` finds them."""
    if not path.is_file():
        raise FileFormatError(f"{path}: found no such file, expected a recipe")
    spec = spec_from_file_location(f"{package.__name__}.{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    if not hasattr(module, "RECIPE"):
        raise FileFormatError(f"{path}: found no RECIPE, expected a recipe that ends with one")
    return module


def _overview(recipes: dict[str, str]) -> None:
    table = Table(box=None, show_header=False, padding=(0, 2))
    for name, summary in recipes.items():
        table.add_row(Text(name, "bold"), summary)
    page = PlainConsole(stderr=False)
    page.print("torchface train RECIPE: learn a model of your own.\n", highlight=False)
    page.print(table, highlight=False)
    page.print(
        "\ntorchface train RECIPE --help shows what it takes; a file of your own is a recipe, too.", highlight=False
    )
