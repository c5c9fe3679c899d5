"""The scans of a corpus spread over processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

import torch
from pebble import ProcessExpired, ProcessPool

from torchface.errors import ValueRangeError
from torchface.registration.corpus.scan_job import CorpusJob
from torchface.registration.corpus.scan_record import CorpusEntry, CorpusTask

_MAX_STARTS = 3  # of a pool whose processes all end while they load
_THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_job: CorpusJob | None = None  # of a worker process, which gets it once


def in_processes(job: CorpusJob, tasks: Sequence[CorpusTask], count: int) -> Iterator[CorpusEntry]:
    """What becomes of each scan, as it becomes known.

    Each process has one thread and one scan at a time. One that dies, such as for lack of memory, takes only its scan
    with it: the scan is reported as skipped, without a record, and another process takes its place. All of them end
    with this process, however it ends.

    Raises:
        ValueRangeError: processes do not start.
    """
    left = {task.name: task for task in tasks}
    for _ in range(_MAX_STARTS):
        for entry in _in_pool(job, list(left.values()), count):
            del left[entry.name]
            yield entry
        if not left:
            return
    raise ValueRangeError(
        f"jobs: all processes ended before they began, {_MAX_STARTS} times; expected them to import the calling "
        'script, which must call register_corpus under if __name__ == "__main__", and enough memory'
    )


def _in_pool(job: CorpusJob, tasks: list[CorpusTask], count: int) -> Iterator[CorpusEntry]:
    """Entries until all are there, or the pool breaks because none of its processes lives."""
    context = multiprocessing.get_context("spawn")
    with _one_thread():
        pool = ProcessPool(min(count, len(tasks)), initializer=_begin, initargs=(job,), context=context)
        try:
            running: dict[Future[CorpusEntry], CorpusTask] = {pool.schedule(_run, args=[task]): task for task in tasks}
            for future in as_completed(running):
                try:
                    yield future.result()
                except ProcessExpired as error:
                    yield _lost(running[future], error.exitcode)
        except BrokenProcessPool:
            return
        finally:
            pool.stop()
            pool.join()


def _lost(task: CorpusTask, code: int) -> CorpusEntry:
    """The entry of a scan whose process has died."""
    end = f"signal {-code}" if code < 0 else f"status {code}"
    why = "; the memory may not have sufficed" if code == -signal.SIGKILL else ""
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


def _begin(job: CorpusJob) -> None:
    global _job
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    _job = job


def _run(task: CorpusTask) -> CorpusEntry:
    assert _job is not None
    return _job.run(task)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
