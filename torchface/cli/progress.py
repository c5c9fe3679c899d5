"""What a command shows while it works: one line a step, with a spinner and the time it has taken."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Annotated

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from tyro.conf import arg

console = Console(stderr=True)

Quiet = Annotated[bool, arg(aliases=["-q"])]
"""The option of every command that shows progress."""


def told(lines: Iterable[str]) -> None:
    """Prints a report, its warnings so that they are seen."""
    for line in lines:
        console.print(line, style="bold yellow" if line.startswith("warning: ") else None, markup=False)


@contextmanager
def steps(quiet: bool = False) -> Iterator[Callable[[str], None]]:
    """Gives a function that names the step just begun; shows nothing when quiet."""
    if quiet:
        yield lambda line: None
        return
    columns = (SpinnerColumn(finished_text="[green]✓"), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        current: list = []

        def finish() -> None:
            for task in current:
                progress.update(task, completed=1)
            current.clear()

        def begin(line: str) -> None:
            finish()
            current.append(progress.add_task(line, total=1))

        try:
            yield begin
        except BaseException:
            for task in current:  # what did not come to an end leaves no line behind
                progress.remove_task(task)
            raise
        finish()
