"""The items of a batch spread over the machines of a Ray cluster."""

import logging
import os
import signal
import socket
import subprocess
import sys
import threading
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from torchface.errors import ValueRangeError
from torchface.files.extra_packages import import_extra
from torchface.files.whole_files import delete_file
from torchface.workflows.batch.batch_items import BatchItem
from torchface.workflows.batch.batch_job import BatchJob, attempt
from torchface.workflows.batch.outcomes import Outcome, record_path, recorded_error, write_record
from torchface.workflows.batch.processes import lost, too_long

_ATTEMPTS = 4
_PORT = 6379
_SECONDS_TO_ANSWER, _SECONDS_TO_JOIN = 3.0, 14.0
_JOIN = """
import logging, sys, ray
print(flush=True)  # loading takes long on a busy machine, and says nothing about the cluster
ray.init(address=sys.argv[1], log_to_driver=False, logging_level=logging.ERROR)
"""
_GRACE = 10.0  # seconds
_POLL = 1.0  # seconds between looks at how many CPUs the cluster has


def check_cluster(address: str) -> None:
    """Raises within 20 seconds where no cluster answers at an address."""
    if _import_ray().is_initialized():
        return
    if address != "auto":
        _check_answers(address)
    # Ray itself waits for minutes for what does not answer as a cluster does; a process can be ended before.
    words = [sys.executable, "-c", _JOIN, address]
    with subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()  # loaded, or ended
            output = process.communicate(timeout=_SECONDS_TO_JOIN)[1].decode(errors="replace").strip().splitlines()
        except subprocess.TimeoutExpired as error:
            why = f"it did not let this process join within {_SECONDS_TO_JOIN:g} seconds"
            raise _none_there(address, why) from error
        finally:
            process.kill()
    if process.returncode:
        raise _none_there(address, (output or [f"status {process.returncode}"])[-1][:300])


def _check_answers(address: str) -> None:
    """Raises where nobody takes a connection at ``HOST:PORT``."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    host, port = (host, port) if host else (port, str(_PORT))
    errors: list[Exception] = []

    def connect() -> None:
        try:
            socket.create_connection((host.strip("[]"), int(port)), _SECONDS_TO_ANSWER).close()
        except (OSError, ValueError, OverflowError) as error:
            errors.append(error)

    # Where name servers do not answer, looking a name up takes longer than any time limit of a connection.
    thread = threading.Thread(target=connect, daemon=True)
    thread.start()
    thread.join(_SECONDS_TO_ANSWER + 1)
    if thread.is_alive():
        raise _none_there(address, f"nobody answered within {_SECONDS_TO_ANSWER:g} seconds")
    if errors:
        raise _none_there(address, str(errors[0])) from errors[0]


def on_cluster(
    job: BatchJob, items: Sequence[BatchItem], out: Path, address: str, time_limit: float | None = None
) -> Iterator[Outcome]:
    """What becomes of each item, as it becomes known.

    Each item takes one CPU, and as many are under way as the cluster has, so that millions do not fill its memory.
    Where a process or a machine is lost its items are given to others, four attempts in all. At the time limit the
    item's process ends.
    """
    ray = _import_ray()
    started_here = not ray.is_initialized()
    if started_here:
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            raise _none_there(address, str(error)) from error
    try:
        shared = ray.put(job)  # kept by this process: no lost machine takes it along
        # What is lost is given out again here, where the time limit is known and each attempt is counted.
        call = ray.remote(num_cpus=1, max_retries=0)(_run)
        under_way: dict[Any, BatchItem] = {}
        waiting, attempts = deque(items), Counter[str]()
        while waiting or under_way:
            room = max(1, int(ray.cluster_resources().get("CPU", 1))) - len(under_way)
            for item in [waiting.popleft() for _ in range(min(room, len(waiting)))]:
                attempts[item.name] += 1
                delete_file(record_path(out, item))  # what an earlier run says of it is not of this one
                under_way[call.remote(shared, item, out, time_limit)] = item
            for reference in ray.wait(list(under_way), num_returns=1, timeout=_POLL)[0]:
                item = under_way.pop(reference)
                try:
                    yield ray.get(reference)
                except ray.exceptions.RayError as error:
                    if time_limit is not None and recorded_error(item, out) == too_long(item, time_limit).error:
                        yield too_long(item, time_limit)
                    elif attempts[item.name] < _ATTEMPTS:
                        waiting.appendleft(item)
                    else:
                        first = str(error).strip().partition("\n")[0]
                        yield lost(item, f"was lost {_ATTEMPTS} times on the cluster: {first}")
    finally:
        if started_here:
            ray.shutdown()


def _run(job: BatchJob, item: BatchItem, out: Path, time_limit: float | None) -> Outcome:
    torch.set_num_threads(1)
    if time_limit is None:
        return attempt(job, item, out)
    watch = threading.Timer(time_limit, _give_up, (item, out, time_limit))
    watch.daemon = True
    _set_alarm(time_limit + _GRACE)
    watch.start()
    try:
        return attempt(job, item, out)
    finally:
        watch.cancel()
        _set_alarm(0)


def _set_alarm(seconds: float) -> None:
    """Ends this process after so many seconds, even where it lets no other thread run; 0 stops the alarm."""
    if sys.platform != "win32":  # no such signal there
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, seconds)


def _give_up(item: BatchItem, out: Path, time_limit: float) -> None:
    """Ends this process; the record shows the driver, to whom the end looks like a lost machine, that it was meant."""
    try:
        write_record(too_long(item, time_limit), "", out, {})
    finally:
        os._exit(1)


def _import_ray() -> Any:
    return import_extra("ray", "ray", "cluster", "a cluster")


def _none_there(address: str, why: str) -> ValueRangeError:
    return ValueRangeError(
        f"cluster: found no Ray cluster at {address!r} ({why}); expected the address of one that runs "
        "(ray start --head starts one), or 'auto' on one of its machines"
    )
