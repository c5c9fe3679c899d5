"""Output of commands on a terminal: results, addresses of pages, errors."""

import os
import signal
import sys
import time
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text
from tyro.conf import arg

from torchface.errors import TorchfaceError
from torchface.escaped_text import visible

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

Quiet = Annotated[bool, arg(aliases=["-q"], help="Show no progress.")]
"""The option of every command that shows progress."""


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
        console.print(line, style="bold yellow" if line.startswith("warning: ") else None, highlight=False)


_MISTAKE, _STOPPED, _NOBODY_READS = 2, 130, 141  # the last is the status of SIGPIPE in shells
_ONCE = 2.0  # seconds


def serve_page(page: "BrowserPage", line: str = "") -> None:
    """Prints a page's address and waits until it is closed, or for Ctrl-C, which closes it and keeps unsaved work."""
    console.print(f"{line}Open this page; Ctrl+C ends.")
    print(page.url, flush=True)
    try:
        page.wait()
    except KeyboardInterrupt:
        page.stop()
        kept = page.keep_unsaved()
        print_lines(
            f"warning: the page's Save did not write the last changes; they are kept in {path}" for path in kept
        )


def count_interrupts_once() -> None:
    """Ends the program on Ctrl-C, ``kill`` or a closed terminal; one soon after another would break that off."""
    before = float("-inf")

    def interrupt(*_: object) -> None:
        nonlocal before
        before, since = time.monotonic(), time.monotonic() - before
        if since > _ONCE:
            raise KeyboardInterrupt

    hang_up, own = getattr(signal, "SIGHUP", signal.SIGTERM), (signal.default_int_handler, signal.SIG_DFL)
    for number in (signal.SIGINT, signal.SIGTERM, hang_up):  # Windows has no SIGHUP
        if signal.getsignal(number) in own:  # a shell's background job ignores Ctrl-C, nohup a closed terminal
            signal.signal(number, interrupt)


@contextmanager
def plain_errors() -> Iterator[None]:
    """Ends with a message and status 2 where the user made a mistake or a file cannot be used, with 130 on Ctrl-C.

    What reads the output may stop doing so, as ``head`` does: that ends quietly, with 141. Each warning is one
    line.

    Raises:
        SystemExit: in place of what was raised inside.
    """
    as_before, warnings.formatwarning = warnings.formatwarning, _WarningLines()
    try:
        try:
            yield
        finally:
            warnings.formatwarning = as_before
            sys.stdout.flush()
    except BrokenPipeError:
        # What is left in the buffer would raise again at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(_NOBODY_READS) from None
    except TorchfaceError as error:
        _say("error", _by_flag(str(error), sys.argv[1:]))
        raise SystemExit(_MISTAKE) from None
    except OSError as error:
        if error.filename is None:
            raise  # nothing that a user could look at
        _say("error", f"{error.filename}: {error.strerror}")
        raise SystemExit(_MISTAKE) from None
    except KeyboardInterrupt:
        _say("stopped", "what was not complete is not written")
        raise SystemExit(_STOPPED) from None


def _by_flag(message: str, given: list[str]) -> str:
    """The message, with the flag that a user typed a value after in place of the argument that got it."""
    argument, found, rest = message.partition(": found ")
    words = [word for text in given for word in (text.split("=", 1) if text.startswith("--") else [text])]
    for flag, value in pairwise(words):
        starts = (f"{value},", f"{value} ", f"no {value!r}")
        if (
            found
            and argument.isidentifier()
            and argument not in words
            and flag.startswith("--")
            and value
            and rest.startswith(starts)
        ):
            return f"{flag}{found}{rest}"
    return message


class _WarningLines:
    """What Python prints of warnings: each text once, without the source's path and line."""

    def __init__(self) -> None:
        self._said: set[str] = set()

    def __call__(self, message: Warning | str, *_: object, **__: object) -> str:
        line = f"warning: {visible(' '.join(str(message).split()))}\n"
        new = line not in self._said
        self._said.add(line)
        return line if new else ""


def _say(what: str, line: str) -> None:
    console.print(Text(f"{what}:", "bold red"), line, highlight=False, soft_wrap=True)
