"""``torchface export app``: the app in the browser as a folder for any static host."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rich.table import Table

from torchface.cli.command_options import Output
from torchface.cli.terminal import Quiet, console, print_path, progress_bars

_FILES = ("character.glb",)


def export_app(
    out: Annotated[Path, Output(_FILES)],
    character: Path | None = None,
    webcam: Path | None = None,
    quiet: Quiet = False,
) -> None:
    """Write the app in the browser: a folder that any static host serves, in which a webcam moves a character.

    Everything runs on the user's machine; the page sends nothing. To try it: `python -m http.server --directory OUT`,
    then open http://localhost:8000. Elsewhere a camera needs https. Where the page is not part of this installation, it
    is built once, which takes Node with npm and the network.

    Args:
        out: The folder to write; an earlier app in it is replaced.
        character: A .glb, or another rig, whose shapes have ARKit's names; the embedded performer if absent.
        webcam: The graph from picture to weights, as `torchface export webcam` writes it; that one if absent.
        quiet: Show no progress.
    """
    from torchface.workflows.browser_app import export_app as write

    with progress_bars(quiet) as progress:
        report = write(out, character, webcam, progress)
    table = Table(show_header=False)
    for row in report.rows():
        table.add_row(*row)
    console.print(table)
    if report.still:
        console.print(f"no face moves {', '.join(report.still)}", soft_wrap=True)
    print_path(out)
