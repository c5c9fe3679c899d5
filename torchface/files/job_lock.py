"""One run at a time into one place: a lock of the operating system, which goes with the process that holds it."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar
from pathlib import Path
from platform import node

from torchface.errors import ValueRangeError
from torchface.files.file_endings import check_ending
from torchface.files.temporary_files import open_plain, remove_left_over, shortened
from torchface.files.whole_files import check_writable, made_folder
from torchface.files.write_errors import unwritten

LOCK = ".lock"
_FAR = 2**30  # Windows locks bytes, and who holds the lock stands in the first ones
_open_to_parts: ContextVar[frozenset[Path]] = ContextVar("open_to_parts", default=frozenset())

if sys.platform == "win32":
    import msvcrt

    def _take(handle: int) -> bool:
        os.lseek(handle, _FAR, os.SEEK_SET)
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

else:
    import fcntl

    def _take(handle: int) -> bool:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError as error:
            warnings.warn(
                f"the file system has no locks ({error.strerror}): another run into the same place goes unnoticed",
                stacklevel=6,
            )
        return True


@contextmanager
def job_lock(folder: str | Path) -> Iterator[Path]:
    """Holds a folder of results for one run, from before its first file to after its last.

    The folder is made where it is missing, and goes again if nothing came into it. The lock is the operating system's:
    however a run ends, the next one may begin.

    Args:
        folder: what ``--out`` names.

    Returns:
        The folder.

    Raises:
        ValueRangeError: another run is writing into it.
        FileFormatError: it cannot be made or written to.
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
    """Holds one file of results, and what is written beside it, for one run; see :func:`job_lock`.

    Args:
        file: what ``--out`` names, or a folder that is written as a whole; what is missing above is made.
        endings: those that the file may have; any if absent.

    Returns:
        The file.

    Raises:
        ValueRangeError: another run is writing it.
        FileFormatError: it has another ending, or its folder cannot be made or written to.
    """
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


@contextmanager
def _locked(path: Path, place: Path) -> Iterator[None]:
    try:
        handle = _taken(path, place)
    except OSError as error:
        raise unwritten(path, error) from error
    try:
        with suppress(OSError):  # a full disk is told by what is written first
            os.ftruncate(handle, 0)
            os.lseek(handle, 0, os.SEEK_SET)
            os.write(handle, f"{os.getpid()} {node()}".encode())
        yield
    finally:
        _let_go(handle, path)


def _taken(path: Path, place: Path) -> int:
    """The lock's file, open and locked."""
    while True:
        try:
            handle = open_plain(path, os.O_RDWR | os.O_CREAT)
        except PermissionError:  # another user's, left by a run that was killed: locked it can be all the same
            handle = open_plain(path, os.O_RDONLY)
        if not _take(handle):
            os.lseek(handle, 0, os.SEEK_SET)
            holder = os.read(handle, 300).decode(errors="replace").split()
            os.close(handle)
            who = f"process {holder[0]} on {holder[1]}" if len(holder) == 2 else "process unknown"
            raise ValueRangeError(
                f"out: found another run writing into {place} ({who}), expected none; wait for its end or name "
                "another place"
            )
        if _is_still(handle, path):
            return handle
        os.close(handle)


def _is_still(handle: int, path: Path) -> bool:
    """Whether the locked file has its name still: whoever held it before has deleted it at the end."""
    try:
        return os.path.samestat(os.fstat(handle), path.lstat())
    except FileNotFoundError:
        return False


def _let_go(handle: int, path: Path) -> None:
    if sys.platform == "win32":  # where an open file cannot be deleted, nor one that another run has opened
        os.close(handle)
        with suppress(OSError):
            path.unlink()
    else:
        with suppress(OSError):
            path.unlink()  # before it is let go: whoever takes it afterwards sees that its name is gone
        os.close(handle)
