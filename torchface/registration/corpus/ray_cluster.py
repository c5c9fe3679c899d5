"""The scans of a corpus spread over the machines of a Ray cluster."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from typing import Any

import torch

from torchface.errors import ValueRangeError
from torchface.files.extra_packages import import_extra
from torchface.registration.corpus.scan_job import CorpusJob
from torchface.registration.corpus.scan_record import CorpusEntry, CorpusTask

_RETRIES = 3


def import_ray() -> Any:
    """The ``ray`` package.

    Raises:
        MissingExtraError: it is not installed.
    """
    return import_extra("ray", "ray", "cluster", "a cluster")


def on_cluster(job: CorpusJob, tasks: Sequence[CorpusTask], address: str) -> Iterator[CorpusEntry]:
    """What becomes of each scan, as it becomes known.

    Each scan takes one CPU. Where a machine is lost its scans are given to others, three times at most.

    Raises:
        MissingExtraError: ray is not installed.
        ValueRangeError: no cluster answers.
    """
    ray = import_ray()
    own = not ray.is_initialized()
    if own:
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            raise ValueRangeError(
                f"cluster: found no Ray cluster at {address!r} ({error}); expected the address of one that runs "
                "(ray start --head starts one), or 'auto' on one of its machines"
            ) from error
    try:
        shared = ray.put(job)  # kept by this process: no lost machine takes it along
        call = ray.remote(num_cpus=1, max_retries=_RETRIES)(_run)
        waiting = {call.remote(shared, task): task for task in tasks}
        while waiting:
            for reference in ray.wait(list(waiting), num_returns=1)[0]:
                task = waiting.pop(reference)
                try:
                    entry = ray.get(reference)
                except ray.exceptions.RayError as error:
                    first = str(error).strip().partition("\n")[0]
                    entry = CorpusEntry(task.name, task.scan, error=f"the cluster lost it: {first}")
                yield entry
    finally:
        if own:
            ray.shutdown()


def _run(job: CorpusJob, task: CorpusTask) -> CorpusEntry:
    torch.set_num_threads(1)
    return job.run(task)
