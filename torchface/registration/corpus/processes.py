"""The scans of a corpus spread over processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

import torch

from torchface.errors import ValueRangeError
from torchface.registration.corpus.scan_job import CorpusJob
from torchface.registration.corpus.scan_record import CorpusEntry, CorpusTask

_MOST_STILLBORN = 3
_THREAD_COUNTS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def in_processes(job: CorpusJob, tasks: Sequence[CorpusTask], count: int) -> Iterator[CorpusEntry]:
    """What becomes of each scan, as it becomes known.

    Each process has one thread and one scan at a time. One that dies (for lack of memory, say) takes only its scan
    with it: the scan is told as skipped, without a record, and another process takes its place. All of them end with
    this process, however it ends.

    Raises:
        ValueRangeError: processes do not start.
    """
    left = deque(tasks)
    workers: dict[Connection, _Worker] = {}
    stillborn = 0
    try:
        for _ in range(min(count, len(tasks))):
            worker = _Worker(job)
            workers[worker.pipe] = worker
        while workers:
            for pipe in wait(list(workers)):
                worker = workers[pipe]  # type: ignore[index]
                entry = worker.answer()
                if not worker.alive:
                    stillborn += not worker.started
                    if stillborn > _MOST_STILLBORN:
                        raise ValueRangeError(
                            f"jobs: {stillborn} processes ended before they began, the last with {worker.end()}; "
                            "expected them to import the calling script, which must call register_corpus under "
                            'if __name__ == "__main__", and enough memory'
                        )
                    del workers[worker.pipe]
                    worker.stop()
                    if left:
                        worker = _Worker(job)
                        workers[worker.pipe] = worker
                elif left:
                    worker.give(left.popleft())
                else:
                    del workers[worker.pipe]
                    worker.stop()
                if entry is not None:
                    yield entry
    finally:
        for worker in workers.values():
            worker.process.terminate()
            worker.stop()


class _Worker:
    """A process, the pipe to it, and the scan it is at."""

    def __init__(self, job: CorpusJob) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, far_end = context.Pipe()
        self.process: BaseProcess = context.Process(target=_work, args=(far_end, job), daemon=True)
        with _one_thread():
            self.process.start()
        far_end.close()  # so that the pipe tells when the process has died
        self.task: CorpusTask | None = None
        self.started = False
        self.alive = True

    def give(self, task: CorpusTask) -> None:
        self.task = task
        with suppress(OSError):  # where it has died, the pipe will tell
            self.pipe.send(task)

    def answer(self) -> CorpusEntry | None:
        """What it made of its scan; None from one that has just started."""
        try:
            entry = self.pipe.recv()
        except (EOFError, OSError):
            return self._died()
        self.started, self.task = True, None
        return entry

    def _died(self) -> CorpusEntry | None:
        self.process.join(5)
        self.alive = False
        if self.task is None:
            return None
        why = "; the memory may not have sufficed" if self.process.exitcode == -signal.SIGKILL else ""
        return CorpusEntry(
            self.task.name, self.task.scan, error=f"the process that registered it ended with {self.end()}{why}"
        )

    def end(self) -> str:
        """How a dead process ended."""
        code = self.process.exitcode
        return f"signal {-code}" if code is not None and code < 0 else f"status {code}"

    def stop(self) -> None:
        self.pipe.close()
        self.process.join(10)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.process.close()


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


def _work(pipe: Connection, job: CorpusJob) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C is the parent's to answer
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    with suppress(EOFError, OSError):  # the parent is gone
        pipe.send(None)
        while True:
            pipe.send(job.run(pipe.recv()))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
