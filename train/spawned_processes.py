"""Work on parts in processes of this machine, for recipes."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import TypeVar

from torchface.errors import TorchfaceError
from torchface.files.parent_process import end_with_parent

Part = TypeVar("Part")
Result = TypeVar("Result")


def map_in_processes(work: Callable[[Part], Result], parts: Sequence[Part], workers: int) -> Iterator[Result]:
    """The results of all parts, in their order; with one worker they are made in this process.

    The processes end with this one, however it ends.
    """
    if workers <= 1 or not parts:
        yield from map(work, parts)
        return
    # Spawned: what a process inherits of torch's threads may not survive a fork.
    pool = ProcessPoolExecutor(min(workers, len(parts)), get_context("spawn"), end_with_parent)
    try:
        yield from pool.map(work, parts)
    except BrokenProcessPool as error:
        raise TorchfaceError(
            f"workers: one of {workers} processes was ended from outside; the memory may not have sufficed: begin "
            "again with fewer workers, what is in files already is kept"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)
