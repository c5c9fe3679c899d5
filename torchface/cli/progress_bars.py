"""Progress bars of commands: steps with bars and rates on a terminal, lines of text elsewhere."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.progress import BarColumn, ProgressColumn, SpinnerColumn, Task, TaskID, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.text import Text

from torchface.cli.terminal import console
from torchface.escaped_text import visible
from torchface.progress import Progress, silent

_LOG_INTERVAL = 30.0  # seconds between two lines of one step where the output is not a terminal


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
        columns = (spinner, _Name(), _Bar(), _Count(), TimeElapsedColumn(), _Remaining())
        # Lines are drawn in Python, beside a live session's frames.
        with Bars(*columns, console=console, refresh_per_second=4) as bars:
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
