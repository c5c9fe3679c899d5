"""One run at a time in one output folder or file: a lock of the operating system, which ends with its process."""

import errno
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from contextvars import ContextVar
from functools import wraps
from inspect import signature
from pathlib import Path
from platform import node
from typing import ParamSpec, TypeVar

from filelock import FileLock, Timeout

from torchface.errors import ValueRangeError
from torchface.files.temporary_files import remove_left_over, shortened
from torchface.files.whole_files import check_ending, check_writable, made_folder
from torchface.files.write_errors import unwritten

LOCK = ".lock"
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP)
Given = ParamSpec("Given")
Result = TypeVar("Result")
Lock = Callable[[str | Path], AbstractContextManager[Path]]
_open_to_parts: ContextVar[frozenset[Path]] = ContextVar("open_to_parts", default=frozenset())


@contextmanager
def job_lock(folder: str | Path) -> Iterator[Path]:
    """Holds a folder of results, which ``--out`` names and it returns, for one run, from before its first file on.

    The folder is made where it is missing, and goes again if nothing came into it. The lock is the operating system's:
    however a run ends, the next one may begin.
    """
    folder = Path(folder)
    path = folder.resolve() / LOCK
    with made_folder(folder), _locked(path, folder):
        remove_left_over(folder)
        token = _open_to_parts.set(_open_to_parts.get() | {path})
        try:
            yield folder
        finally:
            _open_to_parts.reset(token)


@contextmanager
def file_lock(file: str | Path, *endings: str) -> Iterator[Path]:
    """Holds one file of results, of some endings, and what is written beside it, for one run; see :func:`job_lock`."""
    file = Path(file)
    if endings:
        check_ending(file, *endings)
    if file.is_dir():
        check_writable(folder=file)
    else:
        check_writable(file)
    with made_folder(file.parent) as folder, _locked(folder.resolve() / f".{shortened(file.name)}{LOCK}", file):
        yield file


@contextmanager
def within_job(folder: str | Path) -> Iterator[Path]:
    """The folder's lock, for what is a job of its own or the part of one that holds it; see :func:`job_lock`.

    A job has one part at a time: a part within a part is another run.
    """
    folder = Path(folder)
    path = folder.resolve() / LOCK
    with nullcontext() if path in _open_to_parts.get() else job_lock(folder):
        token = _open_to_parts.set(_open_to_parts.get() - {path})
        try:
            yield folder
        finally:
            _open_to_parts.reset(token)


def holds_out(lock: Lock) -> Callable[[Callable[Given, Result]], Callable[Given, Result]]:
    """Has a job hold what its argument ``out`` names while it works, by :func:`within_job` or :func:`file_lock`."""

    def of_job(work: Callable[Given, Result]) -> Callable[Given, Result]:
        @wraps(work)
        def held(*given: Given.args, **named: Given.kwargs) -> Result:
            with lock(signature(work).bind(*given, **named).arguments["out"]):
                return work(*given, **named)

        return held

    return of_job


@contextmanager
def _locked(path: Path, target: Path) -> Iterator[None]:
    """Holds the lock's file, which names its holder and is deleted at the end; ``target`` is for messages."""
    # Whoever may write into the folder may lock the file that another user's killed run left there.
    lock = FileLock(path, mode=0o666, blocking=False, on_acquired=_write_holder)
    try:
        while not lock.is_locked:
            try:
                lock.acquire()
            except Timeout:
                if path.exists():  # else its holder deleted it as it was tried
                    raise
    except Timeout as error:
        raise ValueRangeError(
            f"out: found another run writing into {target} ({_holder(path)}), expected none; wait for its end or name "
            "another place"
        ) from error
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise unwritten(path, error) from error
        warnings.warn(
            f"the file system has no locks ({error.strerror}): another run into the same place goes unnoticed",
            stacklevel=5,
        )
    try:
        yield
    finally:
        with suppress(OSError):  # before it is released: whoever gets it afterwards sees that its name is gone
            path.unlink()
        lock.release()  # on Windows, where an open file keeps its name, this deletes it


def _write_holder(handle: int) -> None:
    """Writes who holds the lock behind its file's first byte, which Windows locks and lets nobody read."""
    with suppress(OSError):  # what is written next reports a full disk
        os.ftruncate(handle, 0)
        os.write(handle, f" {os.getpid()} {node()}".encode())


def _holder(path: Path) -> str:
    try:
        with path.open("rb") as file:
            file.seek(1)
            words = file.read(300).decode(errors="replace").split()
    except OSError:
        words = []
    return f"process {words[0]} on {words[1]}" if len(words) == 2 else "process unknown"
