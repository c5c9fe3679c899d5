"""Output of commands on a terminal: steps with bars and rates, results, addresses of pages, errors."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

from rich.console import Console
from rich.progress import BarColumn, ProgressColumn, SpinnerColumn, Task, TaskID, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.table import Table
from rich.text import Text
from tyro.conf import arg

from torchface.errors import TorchfaceError
from torchface.escaped_text import visible
from torchface.progress import Progress, silent

if TYPE_CHECKING:
    from torchface.viz.browser.browser_page import BrowserPage


class PlainConsole(Console):
    """A console that takes every text for what it says: names from files hold neither markup nor escape sequences.

    Styles are given as ``style=`` or by ``rich.text.Text``, for which ``visible`` must be called.
    """

    def __init__(self, stderr: bool = True) -> None:
        super().__init__(stderr=stderr, markup=False, emoji=False)

    def render_str(self, text: str, **how: Any) -> Text:
        return super().render_str(visible(text), **how)

    def on_broken_pipe(self) -> None:
        """Leaves it to the command's end: rich would end with the status of an error."""
        raise


console = PlainConsole()

Quiet = Annotated[bool, arg(aliases=["-q"])]
"""The option of every command that shows progress."""

_LOG_INTERVAL = 30.0  # seconds between two lines of one step where the output is not a terminal


def print_table(rows: Iterable[tuple[str, ...]], title: str | None = None) -> None:
    """Prints rows of what and how much as a table without a head."""
    table = Table(title=title, show_header=False)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def print_path(path: object) -> None:
    """Prints where a result lies on standard output: as it is for a program, control characters spelled for people."""
    text = str(path)
    try:
        print(visible(text) if sys.stdout.isatty() else text, flush=True)
    except UnicodeEncodeError:  # a name that is no text in the terminal's encoding
        print(visible(text).encode("ascii", "backslashreplace").decode("ascii"), flush=True)


def print_lines(lines: Iterable[str]) -> None:
    """Prints a report, its warnings so that they are seen."""
    for line in lines:
        console.print(line, style="bold yellow" if line.startswith("warning: ") else None)


@contextmanager
def progress_bars(quiet: bool = False) -> Iterator[Progress]:
    """Gives a function that shows each step as it begins and how far it is; shows nothing when quiet.

    On a terminal a step is a line with its time, and a bar and a rate where items are counted. Elsewhere it is a line
    of text, and another every half-minute.
    """
    if quiet:
        yield silent
    elif not console.is_terminal:
        yield _Log()
    else:
        spinner = SpinnerColumn(finished_text="[green]✓")
        with Bars(spinner, _Name(), _Bar(), _Count(), TimeElapsedColumn(), _Remaining(), console=console) as bars:
            steps = _Lines(bars)
            try:
                yield steps
            except BaseException:
                steps.remove()  # what did not come to an end leaves no line behind
                raise
            steps.finish()


class _Lines:
    """The steps of a command as lines of a terminal; the last one is running."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self._running: TaskID | None = None
        self._step = ""

    def __call__(self, step: str, done: int = 0, total: int = 0) -> None:
        if self._running is None or step != self._step:
            self.finish()
            # What an earlier run has done does not count for the rate.
            self._running, self._step = self._bars.add_task(step, total=None, first=done, counted=False), step
        self._bars.update(self._running, completed=done, total=total or None, counted=done > 0 or total > 0)

    def finish(self) -> None:
        """Marks the running step as done."""
        if self._running is not None:
            task = self._bars.tasks[-1]
            items = task.total or task.completed or 1
            self._bars.update(self._running, completed=items, total=items)
            self._running = None

    def remove(self) -> None:
        """Takes the running step's line away."""
        if self._running is not None:
            self._bars.remove_task(self._running)


class _Log:
    """The steps of a command as lines of text."""

    def __init__(self) -> None:
        self._step, self._first, self._begin, self._shown = "", 0, 0.0, 0.0

    def __call__(self, step: str, done: int = 0, total: int = 0) -> None:
        now = time.monotonic()
        if step != self._step:
            self._step, self._first, self._begin, self._shown = step, done, now, now
            console.print(step, markup=False, highlight=False, soft_wrap=True)
        elif now - self._shown >= _LOG_INTERVAL:
            self._shown = now
            of = f" of {total}" if total else ""
            line = f"{step}: {done}{of}, {_rate(done - self._first, now - self._begin)}"
            console.print(line, markup=False, highlight=False, soft_wrap=True)


def _rate(items: float, seconds: float) -> str:
    if items <= 0 or seconds <= 0:
        return ""
    rate = items / seconds
    if rate < 1:
        return f"{60 * rate:.1f} a minute"
    return f"{rate:.{0 if rate >= 10 else 1}f} a second"


class _Name(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(visible(task.description))


class _Bar(BarColumn):
    def render(self, task: Task) -> Any:
        return super().render(task) if task.fields["counted"] else Text()


class _Count(ProgressColumn):
    def render(self, task: Task) -> Text:
        if not task.fields["counted"]:
            return Text()
        of = f"/{task.total:.0f}" if task.total else ""
        seconds = task.finished_time if task.finished else task.elapsed
        return Text(f"{task.completed:.0f}{of} {_rate(task.completed - task.fields['first'], seconds or 0.0)}")


class _Remaining(TimeRemainingColumn):
    def render(self, task: Task) -> Text:
        return super().render(task) if task.fields["counted"] and not task.finished else Text()


_MISTAKE, _STOPPED, _NOBODY_READS = 2, 130, 141  # the last is the status of SIGPIPE in shells


def serve_page(page: BrowserPage, line: str = "") -> None:
    """Prints a page's address and waits until it is closed, or for Ctrl-C, which closes it."""
    console.print(f"{line}Open this page; Ctrl+C ends.")
    print(page.url, flush=True)
    try:
        page.wait()
    except KeyboardInterrupt:
        page.stop()


@contextmanager
def plain_errors() -> Iterator[None]:
    """Ends with a message and status 2 where the user made a mistake or a file cannot be used, with 130 on Ctrl-C.

    What reads the output may stop doing so, as ``head`` does: that ends quietly, with 141.

    Raises:
        SystemExit: in place of what was raised inside.
    """
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # What is left in the buffer would raise again at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(_NOBODY_READS) from None
    except TorchfaceError as error:
        _say("error", str(error))
        raise SystemExit(_MISTAKE) from None
    except OSError as error:
        if error.filename is None:
            raise  # nothing that a user could look at
        _say("error", f"{error.filename}: {error.strerror}")
        raise SystemExit(_MISTAKE) from None
    except KeyboardInterrupt:
        _say("stopped", "what was not complete is not written")
        raise SystemExit(_STOPPED) from None


def _say(what: str, line: str) -> None:
    console.print(Text(f"{what}:", "bold red"), line, highlight=False, soft_wrap=True)
