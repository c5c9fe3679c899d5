"""A worker process that dies, at whatever moment, takes no other scan with it and holds nothing up."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import pytest

from torchface.registration.corpus.processes import in_processes
from torchface.registration.corpus.scan_job import CorpusJob
from torchface.registration.corpus.scan_record import CorpusEntry, CorpusTask


class LastWords(CorpusEntry):
    """Kills the process that reports it: in the middle of what it says, with whatever it holds for that."""

    def __reduce__(self) -> str:
        self.scan.touch()
        os.kill(os.getpid(), signal.SIGKILL)
        return ""


@dataclass(frozen=True)
class Job:
    """Stands in for a registration: one that waits until another process has died, and that other one."""

    def run(self, task: CorpusTask) -> CorpusEntry:
        limit = time.monotonic() + 30
        if task.name == "dies":
            return LastWords(task.name, task.scan)
        while not task.scan.exists() and time.monotonic() < limit:
            time.sleep(0.01)
        return CorpusEntry(task.name, task.scan, result=task.scan)


@pytest.mark.bench  # two processes load the library
def test_a_process_that_dies_while_it_reports_holds_no_other_up(tmp_path: Path) -> None:
    tasks = [CorpusTask(name, tmp_path / "died", None, "") for name in ("dies", "lives")]
    found = {entry.name: entry for entry in in_processes(cast(CorpusJob, Job()), tasks, 2)}
    assert "signal 9" in found["dies"].error
    assert found["lives"].registered
