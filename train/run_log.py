"""What a run measures on the way: a table on disk, TensorBoard where it is installed, and curves."""

from __future__ import annotations

import csv
import io
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchface.files.whole_files import make_folder, write_file

_HEAD = ["seconds", "step", "name", "value"]
_INTERVAL = 5.0  # seconds between two writings of the table


@dataclass(frozen=True)
class Row:
    """A value, when it was measured, and at which step."""

    seconds: float
    step: int
    name: str
    value: float


class RunLog:
    """Keeps values in ``log.csv`` and, where ``torch.utils.tensorboard`` imports, in ``tensorboard/``.

    A run that goes on from a checkpoint takes up the table of the one before: rows of the steps that it does again are
    replaced, and its clock goes on.

    Args:
        folder: of the files; made with the first value.
        goes_on: whether there is a run to take up.
    """

    def __init__(self, folder: Path, goes_on: bool = False) -> None:
        self._folder = folder
        self.rows: list[Row] = read_log(folder / "log.csv") if goes_on else []
        """All that was measured so far."""
        self._resumed, self._begun = bool(self.rows), not self.rows
        self._start = time.monotonic() - (self.rows[-1].seconds if self.rows else 0.0)
        self._written = time.monotonic()
        self._board: Any = None

    def __call__(self, step: int, name: str, value: float) -> None:
        """See :class:`~torchface.progress.ValueLog`."""
        if not self._begun:
            self.rows = [row for row in self.rows if row.step < step]
            self._begun = True
        if self._board is None:
            self._board = _board(self._folder / "tensorboard", step if self._resumed else 0)
        self.rows.append(Row(time.monotonic() - self._start, step, name, float(value)))
        if self._board:
            self._board.add_scalar(name, value, step)
        if time.monotonic() - self._written > _INTERVAL:
            self.write()

    def write(self) -> None:
        """Writes the table, if there is anything in it."""
        self._written = time.monotonic()
        if not self.rows:
            return
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(_HEAD)
        table.writerows((f"{row.seconds:.1f}", row.step, row.name, f"{row.value:.8g}") for row in self.rows)
        make_folder(self._folder)
        write_file(self._folder / "log.csv", text.getvalue().encode())

    def close(self) -> None:
        """Writes all, and the curves."""
        self.write()
        if self._board:
            self._board.close()
        curves = {
            name: [row for row in self.rows if row.name == name] for name in dict.fromkeys(r.name for r in self.rows)
        }
        curves = {name: rows for name, rows in curves.items() if len(rows) > 1}
        if curves:
            write_file(self._folder / "curves.png", _picture(curves))


def read_log(path: Path) -> list[Row]:
    """The rows of a table; none where it is not there or cannot be read."""
    try:
        lines = list(csv.reader(path.read_text().splitlines()))
        if lines[:1] != [_HEAD]:
            return []
        return [Row(float(seconds), int(step), name, float(value)) for seconds, step, name, value in lines[1:]]
    except (OSError, ValueError):
        return []


def _board(folder: Path, step: int) -> Any:
    """A writer for TensorBoard; False where it is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return False
    if not step:
        shutil.rmtree(folder, ignore_errors=True)
    return SummaryWriter(str(folder), purge_step=step or None)


def _picture(curves: dict[str, list[Row]]) -> bytes:
    """A panel a name, as PNG."""
    figure = Figure(figsize=(6, 2.4 * len(curves)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(curves), squeeze=False)[:, 0]
    for axes, (name, rows) in zip(panels, curves.items(), strict=True):
        axes.plot([row.step for row in rows], [row.value for row in rows])
        axes.set(xlabel="step", ylabel=name)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    return content.getvalue()
