"""One run at a time into one place: a lock of the operating system, which goes with the process that holds it."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar
from pathlib import Path
from platform import node

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.whole_files import check_writable, make_folder

LOCK = ".lock"
_LONGEST_NAME = 240  # bytes of a lock's name, which with its ending must stay below the 255 of most file systems
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
        except OSError:  # a file system without locks
            pass
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
    with _made(folder), _locked(folder.resolve() / LOCK, folder):
        yield folder


@contextmanager
def file_lock(file: str | Path) -> Iterator[Path]:
    """Holds one file of results, and what is written beside it, for one run; see :func:`job_lock`.

    Args:
        file: what ``--out`` names; its folder is made where it is missing.

    Returns:
        The file.

    Raises:
        ValueRangeError: another run is writing it.
        FileFormatError: its folder cannot be made or written to.
    """
    file = Path(file)
    check_writable(file)
    name = os.fsdecode(os.fsencode(file.name)[:_LONGEST_NAME])
    with _made(file.parent) as folder, _locked(folder.resolve() / f".{name}{LOCK}", file):
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
def _made(folder: Path) -> Iterator[Path]:
    """The folder, made where it is missing; what was made and stayed empty goes again."""
    missing = [above for above in (folder, *folder.parents) if not os.path.lexists(above)]
    make_folder(folder)
    try:
        yield folder
    finally:
        with suppress(OSError):
            for one in missing:
                one.rmdir()


@contextmanager
def _locked(path: Path, place: Path) -> Iterator[None]:
    handle = _open(path, place)
    token = _open_to_parts.set(_open_to_parts.get() | {path})
    try:
        yield
    finally:
        _open_to_parts.reset(token)
        _let_go(handle, path)


def _open(path: Path, place: Path) -> int:
    """The lock's file, open and locked, with this process named in it."""
    while True:
        try:
            # A link of the lock's name is not followed: what it names would be overwritten.
            handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        except OSError as error:
            raise FileFormatError(
                f"{place}: cannot be written to ({path.name} beside or in it: {error.strerror}); expected a place "
                "that can be written to"
            ) from error
        try:
            taken = _take(handle)
            if taken and _is_still(handle, path):
                os.ftruncate(handle, 0)
                os.pwrite(handle, f"{os.getpid()} {node()}".encode(), 0)
                return handle
        except OSError as error:
            os.close(handle)
            raise FileFormatError(f"{place}: cannot be locked ({path}: {error.strerror})") from error
        holder = os.read(handle, 300).decode(errors="replace").split() if not taken else []
        os.close(handle)
        if not taken:
            who = f"process {holder[0]} on {holder[1]}" if len(holder) == 2 else "process unknown"
            raise ValueRangeError(
                f"out: found another run writing into {place} ({who}), expected none; wait for its end or name "
                "another place"
            )


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
