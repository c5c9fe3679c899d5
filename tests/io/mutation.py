"""Damaged files for readers: mutations of good bytes, and a check in a child process with limits on time and memory.

Readers of whatever format are tested alike::

    from mutation import check_reader

    def test_a_mutated_ply_is_read_or_refused(tmp_path):
        check_reader(load_mesh, [tmp_path / "good.ply"], ".ply")
"""

import os
import random
import re
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from reader_budget import MEGABYTES, SECONDS, find_reader, limit_memory, peak_megabytes, place_of, run_child

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
        cases: how many; ``$TORCHFACE_FUZZ_CASES`` or 100 if absent.
        name: how a case's file name begins.

    Raises:
        AssertionError: a case escaped; the message says which bytes.
    """
    with tempfile.TemporaryDirectory(prefix="mutated-") as folder:
        case = Path(folder, name + suffix)
        job = {
            **place_of(reader),
            "seeds": [str(path) for path in seed_files],
            "case": str(case),
            "cases": cases or int(os.environ.get("TORCHFACE_FUZZ_CASES", "100")),
        }
        try:
            # A child whose every case takes the allowed time is still ended some day.
            return Report(**run_child(_run, job, 120 + SECONDS * int(job["cases"])))
        except AssertionError as escaped:
            kept = Path(tempfile.gettempdir(), f"torchface-{reader.__qualname__}{suffix}")
            kept.write_bytes(case.read_bytes() if case.is_file() else b"")
            raise AssertionError(f"the last case is kept as {kept}\n{escaped}") from None


def _run(job: dict[str, Any], folder: Path) -> dict[str, Any]:
    from torchface.errors import TorchfaceError

    reader, case = find_reader(job), Path(job["case"])
    seeds = [Path(path).read_bytes() for path in job["seeds"]]
    for good in seeds:  # imports, thread pools and caches are paid for before the limits hold
        case.write_bytes(good)
        reader(case)
    limit_memory(MEGABYTES)
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
    return asdict(Report(**outcome, slowest_seconds=slowest, peak_megabytes=peak_megabytes()))
