"""The items of a batch spread over processes of this machine."""

import multiprocessing
import os
import pickle
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import inf
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TYPE_CHECKING, cast

import torch

from torchface.errors import ValueRangeError
from torchface.files.parent_process import end_with_parent
from torchface.workflows.batch.batch_items import BatchItem
from torchface.workflows.batch.batch_job import BatchJob, attempt
from torchface.workflows.batch.outcomes import Outcome

if TYPE_CHECKING:
    if sys.platform == "win32":
        from multiprocessing.connection import PipeConnection as Connection
    else:
        from multiprocessing.connection import Connection

_MAX_STARTS = 3  # of each process, where all end while they load
_SECONDS_TO_END = 3.0
_MOST_BYTES = 2**26  # of an answer
_UNREADABLE = (pickle.UnpicklingError, EOFError, ValueError, TypeError, LookupError, AttributeError, ImportError)
_THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(eq=False)
class _Worker:
    """A process, the item that it has been given and not yet answered for, and its end, where the code does not say."""

    process: SpawnProcess
    item: BatchItem | None = None
    since: float = 0.0
    end: str = ""


def in_processes(
    job: BatchJob, items: Sequence[BatchItem], out: Path, count: int, time_limit: float | None = None
) -> Iterator[Outcome]:
    """What becomes of each item, as it becomes known.

    Each process has one thread and one item at a time. One that dies, such as for lack of memory, or is killed at the
    time limit, takes only its item with it: the item is reported as skipped, without a record, and another process
    takes its place. Processes share nothing that a dead one could keep, no lock and no pipe. All of them end with this
    process, however it ends.
    """
    limit = inf if time_limit is None else time_limit
    waiting = deque(items)
    workers: dict[Connection, _Worker] = {}
    started: list[SpawnProcess] = []
    vain = 0  # processes in a row that ended while they loaded
    try:
        while waiting or workers:
            while len(workers) < count and sum(worker.item is None for worker in workers.values()) < len(waiting):
                pipe, process = _start(job, out)
                workers[pipe] = _Worker(process)
                started.append(process)
            overdue = [w.since + limit - time.monotonic() for w in workers.values() if w.item is not None]
            timeout = min(overdue, default=inf)
            ready = wait(list(workers), None if timeout == inf else max(timeout, 0.0))
            for pipe in cast("list[Connection]", ready):
                worker = workers[pipe]
                try:
                    outcome = _received(pipe, worker)
                except EOFError:
                    del workers[pipe]
                    pipe.close()
                    worker.process.join()
                    if worker.item is not None:
                        yield lost(worker.item, worker.end or _end_text(worker.process.exitcode or 0))
                    elif (vain := vain + 1) >= _MAX_STARTS * min(count, len(items)):
                        raise _none_started() from None
                    continue
                vain, worker.item = 0, None
                if not waiting:
                    del workers[pipe]
                    pipe.close()  # ends the process
                else:
                    worker.item, worker.since = _given(pipe, waiting), time.monotonic()
                if outcome is not None:
                    yield outcome
            for pipe, worker in list(workers.items()):
                if pipe not in ready and worker.item is not None and time.monotonic() - worker.since >= limit:
                    del workers[pipe]
                    worker.process.kill()
                    worker.process.join()
                    pipe.close()
                    yield too_long(worker.item, limit)
    finally:
        _end(started)
        for pipe in workers:
            pipe.close()


def _start(job: BatchJob, out: Path) -> "tuple[Connection, SpawnProcess]":
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(job, out, theirs), daemon=True)
    with _one_thread():
        process.start()
    theirs.close()  # the process alone holds it: the pipe breaks when that dies
    return ours, process


def _received(pipe: "Connection", worker: _Worker) -> Outcome | None:
    """What a process says: that it is ready, None, or the outcome of its item; one that says else is killed."""
    try:
        data = pipe.recv_bytes(_MOST_BYTES)
    except ConnectionError as error:
        raise EOFError from error
    except OSError:  # a length that no outcome has, or half of one
        data = b""
    with suppress(*_UNREADABLE):
        answer = pickle.loads(data)
        if isinstance(answer, Outcome) if worker.item is not None else answer is None:
            return cast("Outcome | None", answer)
    worker.end = "wrote what is no outcome, and was ended"
    worker.process.kill()
    raise EOFError


def _given(pipe: "Connection", waiting: deque[BatchItem]) -> BatchItem | None:
    """The next item, given to a process; None where that has just died."""
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
        'script, which must call this under if __name__ == "__main__", and enough memory'
    )


def lost(item: BatchItem, end: str) -> Outcome:
    """The outcome of an item whose process has died."""
    return Outcome(item, error=f"the process that worked on it {end}")


def too_long(item: BatchItem, limit: float) -> Outcome:
    """The outcome of an item that was stopped at the time limit, seconds."""
    return Outcome(item, error=f"took longer than the time limit of {limit:g} seconds", seconds=limit)


def _end_text(code: int) -> str:
    end = f"signal {-code}" if code < 0 else f"status {code}"
    return f"ended with {end}" + ("; the memory may not have sufficed" if code == -9 else "")


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


def _work(job: BatchJob, out: Path, pipe: "Connection") -> None:
    """What a process does: says that it is ready, then answers each item, until the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one ends it
    end_with_parent()
    torch.set_num_threads(1)
    pipe.send(None)
    while True:
        try:
            item = pipe.recv()
        except (EOFError, OSError):
            return
        outcome = attempt(job, item, out)
        try:
            pipe.send(outcome)
        except OSError:
            return
