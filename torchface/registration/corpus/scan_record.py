"""What is known of one scan of a corpus: in memory, as a JSON record beside the result, as a row of a table."""

from __future__ import annotations

import base64
import csv
import io
import math
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.content_keys import file_digest
from torchface.files.documents import Value, read_json, write_json
from torchface.files.whole_files import write_file
from torchface.registration.nonrigid.stage_record import RegistrationRecord

_FORMAT = "torchface.registered-scan/2"
_MAX_RECORD = 16 * 2**20
_STEP, _NOT_SHOWN = 0.01, 65535
_COLUMNS = (
    "name", "status", "median_mm", "matched", "start", "start_mm", "landmarks", "seconds", "scan", "result", "remarks",
    "p95_mm", "shown", "covered", "stretch", "slid_mm",
)  # fmt: skip
_NUMBERS = {
    "start_distance": "start_mm", "median_distance": "median_mm", "matched": "matched", "far_distance": "p95_mm",
    "shown": "shown", "covered": "covered", "stretch": "stretch", "slid": "slid_mm",
}  # fmt: skip


@dataclass(frozen=True)
class CorpusTask:
    """One scan to register.

    Args:
        name: of the result and the record, without ending.
        scan: the scan's file.
        landmarks: the file of its landmarks, where there is one.
        key: changes when anything that the result depends on does.
    """

    name: str
    scan: Path
    landmarks: Path | None
    key: str


@dataclass(frozen=True)
class CorpusEntry:
    """What became of one scan.

    Args:
        name: of the result and the record, without ending.
        scan: the scan's file.
        result: the registered mesh's file; None where the scan was skipped.
        error: why it was skipped; empty where it was not.
        lasting: the error lies in the scan or its landmarks: another run would meet it again.
        start: how the template came to lie on the scan, see ``RegistrationRecord``.
        start_distance, median_distance: millimetres; NaN where it was skipped.
        matched: share of the vertices whose place the scan tells.
        far_distance, shown, covered, stretch, slid: see ``RegistrationRecord``.
        landmarks: how many were given.
        notes: what was found in the scan, for people to read.
        seconds: wall-clock.
        reused: it was finished by an earlier run.
    """

    name: str
    scan: Path
    result: Path | None = None
    error: str = ""
    lasting: bool = False
    start: str = ""
    start_distance: float = math.nan
    median_distance: float = math.nan
    matched: float = 0.0
    far_distance: float = math.nan
    shown: float = 0.0
    covered: float = 0.0
    stretch: float = math.nan
    slid: float = math.nan
    landmarks: int = 0
    notes: tuple[str, ...] = ()
    seconds: float = 0.0
    reused: bool = False

    @property
    def registered(self) -> bool:
        """Whether there is a result."""
        return self.result is not None


def record_path(folder: Path, name: str) -> Path:
    """Where a scan's record lies."""
    return folder / f"{name}.json"


def write_record(
    entry: CorpusEntry,
    task: CorpusTask,
    record: RegistrationRecord | None,
    folder: Path,
    distances: Tensor | None = None,
) -> None:
    """Writes the record, which declares the scan finished; the result must be there before.

    Args:
        entry, task: of the scan.
        record: of its registration; None where it was skipped.
        folder: of the results.
        distances: of each vertex to the scan, (V,) millimetres, NaN where the scan does not show it.
    """
    stages = [] if record is None else [asdict(stage) for stage in record.stages]
    for stage in stages:
        del stage["energies"]
    document = {
        "format": _FORMAT,
        "key": task.key,
        "status": "registered" if entry.registered else "skipped",
        "scan": str(entry.scan),
        "landmark_file": None if task.landmarks is None else str(task.landmarks),
        "result": None if entry.result is None else entry.result.name,
        "result_sha256": None if entry.result is None else file_digest(entry.result),
        "error": entry.error,
        "start": entry.start,
        **{key: getattr(entry, name) for name, key in _NUMBERS.items()},
        "distances": "" if distances is None else _packed(distances),
        "landmarks": entry.landmarks,
        "notes": list(entry.notes),
        "seconds": entry.seconds,
        "stages": stages,
    }
    write_json(record_path(folder, entry.name), document)


def finished_entry(task: CorpusTask, folder: Path) -> CorpusEntry | None:
    """What an earlier run made of the same scan; None where it made nothing, or anything has changed since."""
    path = record_path(folder, task.name)
    try:
        return _entry(read_json(path, _FORMAT, _MAX_RECORD), task, folder) if path.is_file() else None
    # A record that somebody has damaged is as good as none: the scan is registered again.
    except (FileFormatError, OSError):
        return None


def write_summary(entries: Sequence[CorpusEntry], path: Path) -> None:
    """A row a scan, as CSV; the file appears only when it is complete."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for entry in entries:
        numbers = (f"{entry.median_distance:.4f}", f"{entry.matched:.4f}") if entry.registered else ("", "")
        start = (entry.start, f"{entry.start_distance:.3f}") if entry.registered else ("", "")
        remarks = "; ".join(entry.notes) if entry.registered else entry.error
        writer.writerow(
            (
                entry.name,
                "registered" if entry.registered else "skipped",
                *numbers,
                *start,
                entry.landmarks,
                f"{entry.seconds:.2f}",
                entry.scan,
                "" if entry.result is None else entry.result.name,
                remarks,
                *_figures(entry),
            )
        )
    write_file(path, text.getvalue().encode())


def read_distances(folder: Path, name: str) -> Tensor | None:
    """The distance of each vertex of a result to its scan, (V,) millimetres, NaN where the scan does not show it; None
    where the record tells none."""
    try:
        packed = read_json(record_path(folder, name), max_bytes=_MAX_RECORD)["distances"].text()
        steps = np.frombuffer(base64.b64decode(packed, validate=True), dtype="<u2")
    except (FileFormatError, ValueError):
        return None
    if not len(steps):
        return None
    found = torch.from_numpy(steps.astype(np.float32)) * _STEP
    found[torch.from_numpy(steps == _NOT_SHOWN)] = math.nan
    return found


def _packed(distances: Tensor) -> str:
    """Distances (V,), NaN where not shown, in steps of 0.01 mm."""
    steps = (distances.cpu().double() / _STEP).round().clamp(0, _NOT_SHOWN - 1).nan_to_num(_NOT_SHOWN)
    return base64.b64encode(steps.numpy().astype("<u2").tobytes()).decode()


def _figures(entry: CorpusEntry) -> tuple[str, ...]:
    figures = (entry.far_distance, entry.shown, entry.covered, entry.stretch, entry.slid)
    return tuple("" if math.isnan(x) or not entry.registered else f"{x:.4f}" for x in figures)


def _entry(document: Value, task: CorpusTask, folder: Path) -> CorpusEntry | None:
    if document["key"].found != task.key:
        return None
    entry = CorpusEntry(
        task.name,
        task.scan,
        error=document["error"].text(),
        lasting=True,
        landmarks=document["landmarks"].whole(),
        seconds=document["seconds"].number(),
        reused=True,
    )
    if document["status"].found == "skipped":
        return entry
    result = folder / f"{task.name}.glb"
    if document["result"].found != result.name or not result.is_file():
        return None
    if file_digest(result) != document["result_sha256"].found:
        warnings.warn(f"{result}: found other content than was written, the scan is registered again", stacklevel=2)
        return None
    numbers: dict[str, Any] = {
        name: document[key].number() if document[key] else math.nan for name, key in _NUMBERS.items()
    }
    start, notes = document["start"].text(), document["notes"].texts()
    return replace(entry, result=result, error="", lasting=False, start=start, notes=notes, **numbers)
