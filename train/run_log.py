"""Log of a run: a table on disk, TensorBoard where it is installed, and curves."""

import csv
import io
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchface.files.whole_files import make_folder, write_file
from torchface.files.write_errors import unwritten

_MOST_BYTES = 2**28
_HEAD = "seconds,step,name,value\n"


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
    """

    def __init__(self, folder: Path, goes_on: bool = False) -> None:
        self._folder = folder
        self.rows: list[Row] = read_log(folder / "log.csv") if goes_on else []
        """All that was measured so far."""
        self._resumed, self._begun = bool(self.rows), False
        self._start = time.monotonic() - (self.rows[-1].seconds if self.rows else 0.0)
        self._board: Any = None

    def __call__(self, step: int, name: str, value: float) -> None:
        """See :class:`~torchface.progress.ValueLog`."""
        row = Row(time.monotonic() - self._start, step, name, float(value))
        if self._begun:
            self.rows.append(row)
            self._append(row)
        else:
            self._begun = True
            self.rows = [*(old for old in self.rows if old.step < step), row]
            write_file(make_folder(self._folder) / "log.csv", (_HEAD + _lines(self.rows)).encode())
            self._board = _board(self._folder / "tensorboard", step if self._resumed else 0)
        if self._board:
            self._board.add_scalar(name, value, step)

    def _append(self, row: Row) -> None:
        """Not the whole file again: a long run would spend its time on that. A killed one leaves half a row at most."""
        path = self._folder / "log.csv"
        try:
            with path.open("a") as file:
                file.write(_lines([row]))
        except OSError as error:
            raise unwritten(path, error) from error

    def close(self) -> None:
        """Writes the curves."""
        if self._board:
            self._board.close()
        curves = {
            name: [row for row in self.rows if row.name == name] for name in dict.fromkeys(r.name for r in self.rows)
        }
        curves = {name: rows for name, rows in curves.items() if len(rows) > 1}
        if curves:
            write_file(self._folder / "curves.png", _picture(curves))


def read_log(path: Path) -> list[Row]:
    """The rows of a table, up to one that a killed run has left half; none where it is not there."""
    rows: list[Row] = []
    try:
        if path.stat().st_size > _MOST_BYTES:
            return rows
        for seconds, step, name, value in csv.reader(
            path.read_text("utf-8", "replace").removeprefix(_HEAD).splitlines()
        ):
            rows.append(Row(float(seconds), int(step), name, float(value)))
    except (OSError, ValueError, csv.Error):
        pass
    return rows


def _lines(rows: Sequence[Row]) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerows((f"{row.seconds:.1f}", row.step, row.name, f"{row.value:.8g}") for row in rows)
    return text.getvalue()


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
