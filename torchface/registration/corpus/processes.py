"""The scans of a corpus spread over processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import cast

import torch

from torchface.errors import ValueRangeError
from torchface.registration.corpus.scan_job import CorpusJob
from torchface.registration.corpus.scan_record import CorpusEntry, CorpusTask

_MAX_STARTS = 3  # of each process, where all end while they load
_SECONDS_TO_END = 3.0
_THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(eq=False)
class _Worker:
    """A process, and the scan that it has been given and not yet answered for."""

    process: SpawnProcess
    task: CorpusTask | None = None


def in_processes(job: CorpusJob, tasks: Sequence[CorpusTask], count: int) -> Iterator[CorpusEntry]:
    """What becomes of each scan, as it becomes known.

    Each process has one thread and one scan at a time. One that dies, such as for lack of memory, takes only its scan
    with it: the scan is reported as skipped, without a record, and another process takes its place. Processes share
    nothing that a dead one could keep, no lock and no pipe. All of them end with this process, however it ends.

    Raises:
        ValueRangeError: processes do not start.
    """
    waiting = deque(tasks)
    workers: dict[Connection, _Worker] = {}
    started: list[SpawnProcess] = []
    vain = 0  # processes in a row that ended while they loaded
    try:
        while waiting or workers:
            while len(workers) < count and sum(worker.task is None for worker in workers.values()) < len(waiting):
                pipe, process = _start(job)
                workers[pipe] = _Worker(process)
                started.append(process)
            for pipe in cast("list[Connection]", wait(list(workers))):
                worker = workers[pipe]
                try:
                    entry: CorpusEntry | None = pipe.recv()
                except (EOFError, OSError):
                    del workers[pipe]
                    pipe.close()
                    worker.process.join()
                    if worker.task is not None:
                        yield _lost(worker.task, worker.process.exitcode or 0)
                    elif (vain := vain + 1) >= _MAX_STARTS * min(count, len(tasks)):
                        raise _none_started() from None
                    continue
                vain, worker.task = 0, None
                if not waiting:
                    del workers[pipe]
                    pipe.close()  # ends the process
                else:
                    worker.task = _given(pipe, waiting)
                if entry is not None:
                    yield entry
    finally:
        _end(started)
        for pipe in workers:
            pipe.close()


def _start(job: CorpusJob) -> tuple[Connection, SpawnProcess]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(job, theirs), daemon=True)
    with _one_thread():
        process.start()
    theirs.close()  # the process alone holds it: the pipe breaks when that dies
    return ours, process


def _given(pipe: Connection, waiting: deque[CorpusTask]) -> CorpusTask | None:
    """The next scan, given to a process; None where that has just died."""
    try:
        pipe.send(waiting[0])
    except OSError:
        return None
    return waiting.popleft()


def _end(processes: list[SpawnProcess]) -> None:
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(_SECONDS_TO_END)
        if process.is_alive():
            process.kill()
            process.join()


def _none_started() -> ValueRangeError:
    return ValueRangeError(
        f"jobs: all processes ended before they began, {_MAX_STARTS} times; expected them to import the calling "
        'script, which must call register_corpus under if __name__ == "__main__", and enough memory'
    )


def _lost(task: CorpusTask, code: int) -> CorpusEntry:
    """The entry of a scan whose process has died."""
    end = f"signal {-code}" if code < 0 else f"status {code}"
    why = "; the memory may not have sufficed" if code == -9 else ""
    return CorpusEntry(task.name, task.scan, error=f"the process that registered it ended with {end}{why}")


@contextmanager
def _one_thread() -> Iterator[None]:
    """A process started here computes with one thread: libraries look at these once, when they are loaded."""
    before = {name: os.environ.get(name) for name in _THREAD_COUNTS}
    os.environ.update(dict.fromkeys(_THREAD_COUNTS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(job: CorpusJob, pipe: Connection) -> None:
    """What a process does: says that it is ready, then answers each scan, until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one ends it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    pipe.send(None)
    while True:
        try:
            task = pipe.recv()
        except (EOFError, OSError):
            return
        entry = job.run(task)
        try:
            pipe.send(entry)
        except OSError:
            return


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
