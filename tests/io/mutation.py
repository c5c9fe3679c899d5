"""Damaged files for readers: mutations of good bytes, and a check in a child process with limits on time and memory.

Readers of whatever format are tested alike::

    from mutation import check_reader

    def test_a_mutated_ply_is_read_or_refused(tmp_path):
        check_reader(load_mesh, [tmp_path / "good.ply"], ".ply")
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import json
import multiprocessing
import os
import random
import re
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from typing import Any
from unittest.mock import patch

SECONDS = 2.0
MEGABYTES = 500

_NUMBERS = (
    *(b"-1", b"0", b"1", b"3", b"255", b"65536", b"2147483647", b"2147483648", b"4294967295", b"9999999999"),
    *(b"-9223372036854775808", b"18446744073709551616", b"1e9", b"1e39", b"-1e308", b"1e999", b"nan", b"NaN"),
    *(b"inf", b"-Infinity", b"0.5", b"1,5", b"0x10", b"abc", b"", b'"7"', b"null", b"true", b"[]", b"{}", b"[1]"),
    *(b"1" * 400, b"[" * 3000, b'{"a":' * 3000),
)
_WORDS = (
    *(b"\x00\x00\x00\x00", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\x00\x00\xc0\x7f"),
    *(b"\x00\x00\x80\x7f", b"\x01\x00\x00\x00", b"\x00\x01\x00\x00", b"\x00\x00\x01\x00", b"\x00\x00\x00\x10"),
)
_INSERTS = (
    *(b"\x00", b"\xff", b"\n", b"\r", b" ", b",", b"-", b'"'),
    *(b"/", b"\\", b"#", b"[", b"{", b"\xef\xbb\xbf", b"\xc3\x28"),
)
_NUMBER_TEXT = re.compile(rb"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_KINDS = ("flip", "insert", "delete", "truncate", "splice", "repeat", "number", "number", "number", "word")

_STDERR, _REPORT = "stderr.txt", "report.json"

Operation = tuple[str, int, int, int]
"""What is done, and three numbers that say where and with what (each taken modulo what there is)."""


def apply(data: bytes, operations: Sequence[Operation]) -> bytes:
    """The bytes after these damages, one after the other."""
    for kind, a, b, c in operations:
        size = len(data)
        if size == 0:
            return data
        at = a % size
        if kind == "flip":
            data = data[:at] + bytes([data[at] ^ (1 << b % 8)]) + data[at + 1 :]
        elif kind == "insert":
            data = data[:at] + _INSERTS[b % len(_INSERTS)] * (1 + c % 4) + data[at:]
        elif kind == "delete":
            data = data[:at] + data[at + 1 + b % min(size, 64) :]
        elif kind == "truncate":
            data = data[:at]
        elif kind == "splice":
            source = b % size
            piece = data[source : source + 1 + c % 256]
            data = data[:at] + piece + data[at + len(piece) :]
        elif kind == "repeat":
            piece = data[at : at + 1 + b % 64]
            data = data[:at] + piece * (2 + c % 64) + data[at + len(piece) :]
        elif kind == "number":
            found = list(_NUMBER_TEXT.finditer(data[:65536]))
            if found:
                match = found[a % len(found)]
                data = data[: match.start()] + _NUMBERS[b % len(_NUMBERS)] + data[match.end() :]
        elif kind == "word":
            word = _WORDS[b % len(_WORDS)]
            data = data[:at] + word + data[at + len(word) :]
        else:
            raise ValueError(f"found the operation {kind!r}, expected one of {sorted(set(_KINDS))}")
    return data


def mutated(seed_bytes: bytes, generator: random.Random) -> bytes:
    """A damaged version of ``seed_bytes``, by up to four damages."""
    operations = [
        (generator.choice(_KINDS), generator.getrandbits(31), generator.getrandbits(31), generator.getrandbits(31))
        for _ in range(generator.randint(1, 4))
    ]
    return apply(seed_bytes, operations)


@dataclass(frozen=True)
class Report:
    """What came of the cases: how many were read after all, how many refused, and the worst of time and memory."""

    cases: int
    read: int
    refused: int
    slowest_seconds: float
    peak_megabytes: float


def check_reader(
    reader: Callable[[Path], Any],
    seed_files: Sequence[Path],
    suffix: str,
    cases: int | None = None,
    name: str = "case",
) -> Report:
    """Drives a reader with mutated files; each must be read or refused by a ``TorchfaceError``, in time and memory.

    The cases run in a child process whose address space may grow by 500 MB, so that neither a crash nor a count of
    gigabytes takes the tests along. Time is the child's processor time, 2 s a case.

    Args:
        reader: a function of a path, at the top level of its module.
        seed_files: good files; the reader must accept them.
        suffix: how a case's file name ends, with the dot.
        cases: how many; ``$TORCHFACE_FUZZ_CASES`` or 200 if absent.
        name: how a case's file name begins.

    Raises:
        AssertionError: a case escaped; the message tells which bytes.
    """
    job = {
        "file": inspect.getfile(reader),
        "module": reader.__module__,
        "reader": reader.__qualname__,
        "seeds": [str(path) for path in seed_files],
        "suffix": suffix,
        "name": name,
        "cases": cases or int(os.environ.get("TORCHFACE_FUZZ_CASES", "200")),
    }
    with tempfile.TemporaryDirectory(prefix="mutated-") as folder:
        child = _children().Process(target=_run_child, args=(job, Path(folder)))
        child.start()
        # A child whose every case takes the allowed time is still ended some day.
        child.join(120 + SECONDS * int(job["cases"]))
        if child.is_alive():
            child.kill()
            child.join()
        case = Path(folder, name + suffix)
        if child.exitcode != 0:
            kept = Path(tempfile.gettempdir(), f"torchface-{reader.__qualname__}{suffix}")
            kept.write_bytes(case.read_bytes() if case.is_file() else b"")
            raise AssertionError(
                f"{reader.__qualname__}: the child ended with {child.exitcode}; its last case is kept as {kept}\n"
                f"{Path(folder, _STDERR).read_text(errors='replace')[-6000:]}"
            )
        return Report(**json.loads(Path(folder, _REPORT).read_text()))


def _children() -> Any:
    """Where children are forked from: a process of one thread that has paid for the imports once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torchface.io", "torchface.zoo", "pytest", "hypothesis"])
    with patch.dict(os.environ, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MALLOC_ARENA_MAX="2"):
        ensure_running()
    return context


def _run_child(job: dict[str, Any], folder: Path) -> None:
    os.dup2(os.open(folder / _STDERR, os.O_WRONLY | os.O_CREAT), sys.stderr.fileno())
    (folder / _REPORT).write_text(json.dumps(_run(job, folder).__dict__))


def _run(job: dict[str, Any], folder: Path) -> Report:
    from torchface.errors import TorchfaceError

    reader = _find_reader(job)
    seeds = [Path(path).read_bytes() for path in job["seeds"]]
    case = folder / (job["name"] + job["suffix"])
    for good in seeds:  # imports, thread pools and caches are paid for before the limits hold
        case.write_bytes(good)
        reader(case)
    _limit_memory()
    outcome = {"cases": 0, "read": 0, "refused": 0}
    slowest = 0.0

    generator = random.Random(0)
    for _ in range(job["cases"]):
        case.write_bytes(mutated(generator.choice(seeds), generator))
        start = time.process_time()
        try:
            reader(case)
            outcome["read"] += 1
        except TorchfaceError:
            outcome["refused"] += 1
        taken = time.process_time() - start
        outcome["cases"] += 1
        slowest = max(slowest, taken)
        assert taken <= SECONDS, f"the case took {taken:.1f} s, expected at most {SECONDS} s"
    return Report(**outcome, slowest_seconds=slowest, peak_megabytes=_peak_megabytes())


def _find_reader(job: dict[str, Any]) -> Callable[[Path], Any]:
    if job["module"].startswith("torchface."):
        module = importlib.import_module(job["module"])
    else:  # a test file is no importable module
        spec = importlib.util.spec_from_file_location("reader_under_test", job["file"])
        if spec is None or spec.loader is None:
            raise ImportError(job["file"])
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return getattr(module, job["reader"])


def _limit_memory() -> None:
    status = Path("/proc/self/status")
    if not status.exists():  # only Linux both tells the size and keeps the limit
        return
    import resource

    now = int(re.findall(r"VmSize:\s+(\d+) kB", status.read_text())[0]) * 1024
    resource.setrlimit(resource.RLIMIT_AS, (now + MEGABYTES * 2**20, now + MEGABYTES * 2**20))
    Path("/proc/self/clear_refs").write_text("5")  # forgets the peak so far
    _START["resident"] = float(re.findall(r"VmRSS:\s+(\d+) kB", status.read_text())[0])


_START: dict[str, float] = {}


def _peak_megabytes() -> float:
    status = Path("/proc/self/status")
    if not status.exists():
        return float("nan")
    return (float(re.findall(r"VmHWM:\s+(\d+) kB", status.read_text())[0]) - _START["resident"]) / 1024
