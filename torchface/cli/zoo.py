"""``torchface zoo``: what learned models there are, what is known of them, and whether they are undamaged."""

from collections.abc import Callable
from typing import Annotated

from rich.console import ConsoleDimensions
from rich.table import Table
from rich.text import Text
from tyro.conf import Positional, arg

from torchface.cli.terminal import PlainConsole
from torchface.escaped_text import visible

SOME_DAMAGED = 1
"""Exit status of ``torchface zoo verify`` where a model is damaged."""
_WIDE = 1000  # characters of a line where the output is not a terminal, which would have a width


def list_models() -> None:
    """List the learned models: name, kind, size, licence, and what each is in a line.

    Those that come with torchface and those in $TORCHFACE_HOME; on standard output. A damaged one is listed as such,
    with what was found. `torchface zoo describe NAME` shows more of one, `torchface zoo verify` reads every file.
    """
    from torchface import zoo
    from torchface.zoo.model_folders import all_names

    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("name", "kind", "size", "licence"):
        table.add_column(title, no_wrap=True)
    table.add_column("what it is")
    faults = zoo.damaged_models()
    for name in sorted(all_names()):
        if name in faults:
            table.add_row(name, "damaged", "", "", "see below")
        else:
            model = zoo.describe(name)
            table.add_row(
                name,
                model.kind,
                _size(model.size),
                model.licence,
                Text(visible(model.summary), no_wrap=True, overflow="ellipsis"),
            )
    page = PlainConsole(stderr=False)
    if not page.is_terminal:
        page.size = ConsoleDimensions(_WIDE, page.height)
    page.print(table, highlight=False)
    for name, fault in faults.items():
        page.print(f"{name}: {fault}", style="bold yellow", highlight=False, soft_wrap=True)


def describe(name: Positional[str]) -> None:
    """Show what is known of one learned model, without loading it.

    Its kind and class, size, licence, the data that it has learned from, what was measured on data held out, the
    command that makes it again, where it lies and comes from, and the sha256 of its state; on standard output.

    Args:
        name: Of `torchface zoo list`, or the path of a model's folder.
    """
    from torchface import zoo

    model = zoo.describe(name)
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    page = PlainConsole(stderr=False)
    table.add_column(max_width=max(page.width // 3, 12))
    table.add_column(overflow="fold")
    learned = zoo.KINDS.get(model.kind)
    rows = {
        "name": model.name,
        "what it is": model.summary,
        "kind": f"{model.kind} ({learned.__name__})" if learned else f"{model.kind} (unknown to this torchface)",
        "size": _size(model.size),
        "licence": model.licence,
        "data": model.data,
        **{key: f"{value:.4g}" for key, value in model.metrics.items()},
        "recipe": model.recipe,
        "folder": str(model.folder),
        "url": model.url,
        "sha256": model.sha256,
        "goes before": ", ".join(map(str, model.shadowed)),
    }
    for key, value in rows.items():
        if value:
            table.add_row(key, value)
    page.print(table, highlight=False)


def verify(names: Annotated[Positional[tuple[str, ...]], arg(metavar="[NAME ...]")] = ()) -> None:
    """Check learned models: that each one's files are there, have their size and hash, and load.

    A line a model, on standard output: that it is whole, or what was found and what was expected. The exit status is 1
    if one is damaged.

    Args:
        names: Of `torchface zoo list`, or paths of models' folders; all models if absent.
    """
    from torchface import zoo
    from torchface.errors import FileFormatError
    from torchface.zoo.model_folders import all_names

    page, damaged = PlainConsole(stderr=False), False
    for name in names or sorted(all_names()):
        try:
            model = zoo.verify(name)
        except FileFormatError as error:
            page.print(f"{name}: damaged: {error}", style="bold yellow", highlight=False, soft_wrap=True)
            damaged = True
        else:
            line = f"{name}: whole, {_size(model.size)}, sha256 {model.sha256}"
            page.print(line, highlight=False, soft_wrap=True)
    if damaged:
        raise SystemExit(SOME_DAMAGED)


def _size(count: int) -> str:
    """Bytes as people read them."""
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.0f} kB"


ZOO: dict[str, Callable[..., None]] = {"list": list_models, "describe": describe, "verify": verify}
