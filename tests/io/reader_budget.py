"""What a reader may take of memory and time, measured in a child process.

Readers of whatever format are held to one budget::

    from reader_budget import check_budget

    def test_a_wide_table_is_read_within_the_budget(tmp_path):
        (tmp_path / "wide.csv").write_text(...)
        check_budget(load_take, tmp_path / "wide.csv")
"""

import importlib
import importlib.util
import inspect
import json
import multiprocessing
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from typing import Any
from unittest.mock import patch

SECONDS = 2.0
"""Processor time that a file of any size may take, in megabytes of it at least as much again each."""
MEGABYTES = 500
"""Memory that a file of any size may take, in multiples of 20 for larger ones."""

_SIZES = 20
_ALLOWED_AT_ALL = 3  # times the budget: then the child is ended, so that the machine outlives a reader without bounds
_WAITED = 100  # times the processor time, for the machine may be busy with other work
_STDERR, _REPORT = "stderr.txt", "report.json"
_STATUS = Path("/proc/self/status")
_START: dict[str, float] = {}


@dataclass(frozen=True)
class Cost:
    """What a reader took for a file."""

    file_megabytes: float  # the file's size; a folder's is that of all its files
    seconds: float  # processor time
    megabytes: float  # how far the memory in use rose at its highest
    refused: str  # the message of the `TorchfaceError` that refused the file; empty where it was read

    def within_budget(self) -> bool:
        """At most 500 MB or 20 times the file, whichever is more, and 2 s and 2 s a megabyte."""
        enough = self.megabytes <= memory_budget(self.file_megabytes) if self.megabytes == self.megabytes else True
        return enough and self.seconds <= time_budget(self.file_megabytes)


def memory_budget(file_megabytes: float) -> float:
    """Megabytes that reading a file of so many may take."""
    return max(MEGABYTES, _SIZES * file_megabytes)


def time_budget(file_megabytes: float) -> float:
    """Seconds of processor time that reading a file of so many megabytes may take."""
    return SECONDS * (1 + file_megabytes)


def check_budget(reader: Callable[[Path], Any], path: Path, good: Path | None = None) -> Cost:
    """Reads a file in a child process; it must be read or refused by a ``TorchfaceError``, within the budget.

    Args:
        reader: a function of a path, at the top level of its module.
        path: the file, or a folder of files.
        good: a small file that the child reads before, so that imports are not counted.

    Raises:
        AssertionError: the budget was passed, or the child ended otherwise; the message says how.
    """
    cost = measure(reader, path, good)
    assert cost.within_budget(), (
        f"{reader.__qualname__} took {cost.seconds:.1f} s and {cost.megabytes:.0f} MB for a file of "
        f"{cost.file_megabytes:.3f} MB, expected at most {time_budget(cost.file_megabytes):.1f} s and "
        f"{memory_budget(cost.file_megabytes):.0f} MB"
    )
    return cost


def measure(reader: Callable[[Path], Any], path: Path, good: Path | None = None) -> Cost:
    """What reading a file takes, whether or not that is within the budget; see :func:`check_budget`.

    Raises:
        AssertionError: the child ended otherwise than by a value or a ``TorchfaceError``, or took thrice the budget.
    """
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    size = sum(file.stat().st_size for file in files) / 2**20
    job = {**place_of(reader), "path": str(path), "good": None if good is None else str(good), "megabytes": size}
    report = run_child(_measure, job, _ALLOWED_AT_ALL * time_budget(size))
    return Cost(**report)


def run_child(work: Callable[[dict[str, Any], Path], Any], job: dict[str, Any], seconds: float) -> dict[str, Any]:
    """What ``work`` returns in a child process that knows how to find a reader and has paid for the imports.

    Args:
        work: of the job and an empty folder; returns what JSON can hold.
        job: of what JSON can hold.
        seconds: of processor time after which a child is ended.

    Raises:
        AssertionError: the child crashed, was ended, or raised; the message holds what it wrote.
    """
    with tempfile.TemporaryDirectory(prefix="reader-") as folder:
        child = _children().Process(target=_report, args=(work, job, Path(folder), seconds))
        child.start()
        child.join(60 + _WAITED * seconds)
        if child.is_alive():
            child.kill()
            child.join()
        if child.exitcode != 0:
            said = Path(folder, _STDERR)
            raise AssertionError(
                f"{job['reader']}: the child ended with {child.exitcode}\n"
                f"{said.read_text(errors='replace')[-6000:] if said.exists() else ''}"
            )
        return dict(json.loads(Path(folder, _REPORT).read_text()))


def place_of(reader: Callable[..., Any]) -> dict[str, str]:
    """Where a child finds the function; see :func:`find_reader`."""
    return {"file": inspect.getfile(reader), "module": reader.__module__, "reader": reader.__qualname__}


def find_reader(job: dict[str, Any]) -> Callable[..., Any]:
    """The function that :func:`place_of` says where to find."""
    if job["module"].startswith("torchface."):
        module = importlib.import_module(job["module"])
    else:  # a test file is no importable module
        spec = importlib.util.spec_from_file_location("reader_under_test", job["file"])
        if spec is None or spec.loader is None:
            raise ImportError(job["file"])
        module = importlib.util.module_from_spec(spec)
        sys.modules["reader_under_test"] = module
        spec.loader.exec_module(module)
    return getattr(module, job["reader"])


def limit_memory(megabytes: float) -> None:
    """Ends this process's growth at so many megabytes of addresses from here on, and forgets its peak so far."""
    if not _STATUS.exists():  # only Linux both reports the size and keeps the limit
        return
    import resource

    largest = (_kilobytes("VmSize") * 1024) + int(megabytes * 2**20)
    resource.setrlimit(resource.RLIMIT_AS, (largest, largest))
    Path("/proc/self/clear_refs").write_text("5")
    _START["resident"] = _kilobytes("VmRSS")


def peak_megabytes() -> float:
    """How far the memory in use rose at its highest since :func:`limit_memory`; NaN where the system does not tell."""
    return (_kilobytes("VmHWM") - _START["resident"]) / 1024 if _STATUS.exists() else float("nan")


def _kilobytes(field: str) -> int:
    return int(re.findall(rf"{field}:\s+(\d+) kB", _STATUS.read_text())[0])


def _children() -> Any:
    """Where children are forked from: a process of one thread that has paid for the imports once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torchface.io", "torchface.zoo", "pytest", "hypothesis", "trimesh"])
    # Whoever runs the tests may have the allocator keep what is freed; readers are held to what they take without that.
    kept = {"MALLOC_MMAP_THRESHOLD_": "131072", "MALLOC_TRIM_THRESHOLD_": "131072", "MALLOC_ARENA_MAX": "2"}
    with patch.dict(os.environ, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", **kept):
        ensure_running()
    return context


def _report(work: Callable[[dict[str, Any], Path], Any], job: dict[str, Any], folder: Path, seconds: float) -> None:
    os.dup2(os.open(folder / _STDERR, os.O_WRONLY | os.O_CREAT), sys.stderr.fileno())
    if _STATUS.exists():
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time() + seconds) + 2, resource.RLIM_INFINITY))
    (folder / _REPORT).write_text(json.dumps(work(job, folder)))


def _measure(job: dict[str, Any], folder: Path) -> dict[str, Any]:
    from torchface.errors import TorchfaceError

    reader, refused = find_reader(job), ""
    if job["good"]:
        reader(Path(job["good"]))
    limit_memory(_ALLOWED_AT_ALL * memory_budget(job["megabytes"]))
    start = time.process_time()
    try:
        reader(Path(job["path"]))
    except TorchfaceError as error:
        refused = str(error)
    taken = time.process_time() - start
    return {
        "file_megabytes": job["megabytes"],
        "seconds": taken,
        "megabytes": peak_megabytes(),
        "refused": refused,
    }
