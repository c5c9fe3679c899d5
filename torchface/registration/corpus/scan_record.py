"""What is told of one scan of a corpus: in memory, as a JSON record beside the result, as a row of a table."""

from __future__ import annotations

import base64
import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file, write_file
from torchface.registration.nonrigid.stage_record import RegistrationRecord

_FORMAT = "torchface.registered-scan/1"
_LARGEST_RECORD = 16 * 2**20
_STEP, _NOT_SHOWN = 0.01, 65535
_COLUMNS = (
    "name", "status", "median_mm", "matched", "start", "start_mm", "landmarks", "seconds", "scan", "result", "remarks",
    "p95_mm", "shown", "covered", "stretch", "slid_mm",
)  # fmt: skip


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
        "result_bytes": 0 if entry.result is None else entry.result.stat().st_size,
        "error": entry.error,
        "start": entry.start,
        "start_mm": entry.start_distance,
        "median_mm": entry.median_distance,
        "matched": entry.matched,
        "p95_mm": entry.far_distance,
        "shown": entry.shown,
        "covered": entry.covered,
        "stretch": entry.stretch,
        "slid_mm": entry.slid,
        "distances": "" if distances is None else _packed(distances),
        "landmarks": entry.landmarks,
        "notes": list(entry.notes),
        "seconds": entry.seconds,
        "stages": stages,
    }
    write_file(record_path(folder, entry.name), json.dumps(_without_nan(document), indent=1).encode())


def finished_entry(task: CorpusTask, folder: Path) -> CorpusEntry | None:
    """What an earlier run made of the same scan; None where it made nothing, or anything has changed since."""
    path = record_path(folder, task.name)
    if not path.is_file():
        return None
    try:
        document = json.loads(read_file(path, _LARGEST_RECORD))
        entry = _entry(document, task, folder)
    # A record that somebody has damaged is as good as none: the scan is registered again.
    except (FileFormatError, ValueError, TypeError, KeyError, AttributeError, RecursionError, OSError):
        return None
    return entry


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
        packed = json.loads(read_file(record_path(folder, name), _LARGEST_RECORD))["distances"]
        steps = np.frombuffer(base64.b64decode(packed, validate=True), dtype="<u2")
    except (FileFormatError, ValueError, TypeError, KeyError, RecursionError):
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


def _entry(document: dict[str, Any], task: CorpusTask, folder: Path) -> CorpusEntry | None:
    if document["format"] != _FORMAT or document["key"] != task.key or document["status"] != "registered":
        return None if document["status"] != "skipped" or document["key"] != task.key else _skipped(document, task)
    result = folder / f"{task.name}.glb"
    if document["result"] != result.name or result.stat().st_size != document["result_bytes"]:
        return None
    return replace(
        _skipped(document, task),
        result=result,
        error="",
        lasting=False,
        start=str(document["start"]),
        start_distance=_number(document["start_mm"]),
        median_distance=_number(document["median_mm"]),
        matched=_number(document["matched"]),
        far_distance=_number(document["p95_mm"]),
        shown=_number(document["shown"]),
        covered=_number(document["covered"]),
        stretch=_number(document["stretch"]),
        slid=_number(document["slid_mm"]),
        notes=tuple(map(str, document["notes"])),
    )


def _skipped(document: dict[str, Any], task: CorpusTask) -> CorpusEntry:
    return CorpusEntry(
        task.name,
        task.scan,
        error=str(document["error"]),
        lasting=True,
        landmarks=int(document["landmarks"]),
        seconds=_number(document["seconds"]),
        reused=True,
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: null instead."""
    if isinstance(value, dict):
        return {key: _without_nan(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_without_nan(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
