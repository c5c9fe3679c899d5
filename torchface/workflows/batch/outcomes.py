"""Outcome of one item: in memory, as a JSON record below its results, as a row of the table."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchface.errors import FileFormatError
from torchface.escaped_text import visible
from torchface.files.content_keys import file_digest
from torchface.files.documents import Value, read_json, write_json
from torchface.files.whole_files import make_folder
from torchface.io.tables.csv_table import write_table
from torchface.workflows.batch.batch_items import RECORDS, BatchItem

if TYPE_CHECKING:
    from torch import Tensor

_FORMAT = "torchface.batch-item/1"
_MAX_RECORD = 16 * 2**20
_DONE, _SKIPPED = "done", "skipped"
_COLUMNS = ("name", "status", "seconds", "processor_seconds", "input", "results", "remarks")

RESULT = "result"
"""The figure that says whether an item's result is to be used: good, partly usable, poor or none."""

Figures = Mapping[str, float | str]  # what was measured, by column of the table


@dataclass(frozen=True, eq=False)
class Made:
    """What a job has made of an item."""

    results: tuple[Path, ...]  # the files, inside the folder of results
    figures: Figures = field(default_factory=dict)
    headline: str = ""  # the most telling of it, a few words for the contact sheet
    notes: tuple[str, ...] = ()  # what people should know before they use the results
    picture: "Tensor | None" = None  # for the contact sheet, (3,H,W) in [0,1]
    details: Mapping[str, Any] = field(default_factory=dict)  # what else the record is to hold


@dataclass(frozen=True)
class Outcome:
    """What became of one item."""

    item: BatchItem
    results: tuple[Path, ...] = ()  # the files; empty where it was skipped
    # figures, headline, notes: see Made
    figures: Figures = field(default_factory=dict)
    headline: str = ""
    notes: tuple[str, ...] = ()
    error: str = ""  # why it was skipped; empty where it was not
    lasting: bool = False  # the error lies in the item itself: another run would meet it again
    fatal: bool = False  # the error meets every item, such as a full disk
    seconds: float = 0.0
    processor_seconds: float = 0.0  # of all threads
    reused: bool = False  # it was finished by an earlier run

    @property
    def name(self) -> str:
        """Of the item, its results and its record."""
        return self.item.name

    @property
    def done(self) -> bool:
        """Whether there are results."""
        return not self.error


def word_of(verdict: str) -> str:
    """The word of a line ``result: WORD, ...``."""
    return verdict.removeprefix("result: ").split(",")[0]


def record_path(out: Path, item: BatchItem) -> Path:
    """Where an item's record lies."""
    return out / RECORDS / f"{item.name}.json"


def write_record(outcome: Outcome, key: str, out: Path, details: Mapping[str, Any]) -> None:
    """Writes the record, which declares the item finished; the results must be there before."""
    document = {
        "format": _FORMAT,
        "key": key,
        "status": _DONE if outcome.done else _SKIPPED,
        "input": str(outcome.item.path),
        "results": {path.relative_to(out).as_posix(): file_digest(path) for path in outcome.results},
        "error": outcome.error,
        "lasting": outcome.lasting,
        "figures": dict(outcome.figures),
        "headline": outcome.headline,
        "notes": list(outcome.notes),
        "seconds": outcome.seconds,
        "processor_seconds": outcome.processor_seconds,
        "details": dict(details),
    }
    path = record_path(out, outcome.item)
    make_folder(path.parent)
    write_json(path, document)


def finished_outcome(item: BatchItem, key: str, out: Path) -> Outcome | None:
    """What an earlier run has made of an item, or why it could not; None where there is none that still holds.

    A record that is damaged is as good as none: the item is worked on again.
    """
    try:
        document = read_json(record_path(out, item), _FORMAT, _MAX_RECORD)
        return _outcome(document, item, key, out)
    except (FileFormatError, OSError):
        return None


def recorded_error(item: BatchItem, out: Path) -> str:
    """Why an item was skipped, by its record; empty where there is none that says so."""
    try:
        return read_json(record_path(out, item), _FORMAT, _MAX_RECORD)["error"].text()
    except (FileFormatError, OSError):
        return ""


def write_summary(outcomes: Sequence[Outcome], path: Path) -> None:
    """A row an item, as CSV; the file appears only when it is complete."""
    columns = list(dict.fromkeys(name for outcome in outcomes for name in outcome.figures))
    rows = []
    for outcome in outcomes:
        cells = [_cell(outcome.figures.get(name, "")) for name in columns]
        results = "; ".join(file.relative_to(path.parent).as_posix() for file in outcome.results)
        remarks = outcome.error or "; ".join(outcome.notes)
        status = _DONE if outcome.done else _SKIPPED
        seconds = (f"{outcome.seconds:.2f}", f"{outcome.processor_seconds:.2f}")
        row = [outcome.name, status, *seconds, str(outcome.item.path), results, remarks, *cells]
        rows.append([visible(cell) for cell in row])  # names of files need not be Unicode
    write_table(path, [*_COLUMNS, *columns], rows)


def _cell(value: float | str) -> str:
    if isinstance(value, str | int):
        return str(value)
    return "" if value != value else f"{value:.4f}"  # NaN is unknown


def _outcome(document: Value, item: BatchItem, key: str, out: Path) -> Outcome | None:
    if document["key"].found != key:
        return None
    results = []
    for name, digest in document["results"].table().items():
        path = out / name
        if not path.resolve().is_relative_to(out) or not path.is_file():
            return None
        if file_digest(path) != digest.text():
            warnings.warn(f"{path}: found other content than was written, it is made again", stacklevel=3)
            return None
        results.append(path)
    error = document["error"].text()
    if (error and not document["lasting"].found) or (not error and not results):
        return None
    figures = {
        name: value.text() if isinstance(value.found, str) else value.number() if value else float("nan")
        for name, value in document["figures"].table().items()
    }
    return Outcome(
        item,
        tuple(results),
        {
            name: int(value) if type(document["figures"][name].found) is int else value
            for name, value in figures.items()
        },
        document["headline"].text(),
        document["notes"].texts(),
        error,
        bool(error),
        seconds=document["seconds"].number(),
        processor_seconds=document["processor_seconds"].number(),
        reused=True,
    )
