"""Errors of writing that say what to do about them."""

import errno
import os
import shutil
from pathlib import Path

from torchface.errors import FileFormatError

_LONGEST_NAME = 255


def unwritten(path: Path, error: Exception) -> FileFormatError:
    """The error of a file, not of a temporary one, that could not be written."""
    unchanged = "; what was there before is unchanged" if _is_file(path) else ""
    return FileFormatError(f"{path}: cannot be written: {_reason(path, error)}{unchanged}")


def unsettled(path: Path, error: Exception) -> FileFormatError:
    """The error of a file that has its place, on a disk that does not say that it will keep it."""
    return FileFormatError(f"{path}: written, and may be lost in a power cut: {_reason(path, error)}")


def unmade(folder: Path, error: Exception) -> FileFormatError:
    """The error of a folder that could not be made; see :func:`unwritten`."""
    return FileFormatError(f"{folder}: found no folder, and it cannot be made: {_reason(folder, error)}")


def _is_file(path: Path) -> bool:
    """Whether a plain file is there; whatever cannot be looked at is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _reason(path: Path, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number == errno.ENOSPC:
        return f"the disk is full{_room(path)}; free some, or name a place on another disk"
    if number == errno.EDQUOT:
        return "the quota is used up; free some, or name another place"
    if number == errno.EFBIG:
        return "the file would be larger than the file system or the shell's limit (ulimit -f) takes"
    if number == errno.EIO:
        return "the disk reports an input/output error: it fails, or a network drive is gone; name another place"
    if number == errno.EROFS:
        return "the file system is read-only; name another place"
    if number in (errno.EACCES, errno.EPERM):
        return f"found no permission to write into {path.parent}; change it, or name another place"
    if number == errno.ENAMETOOLONG:
        longest = max(path.parts, key=lambda part: len(os.fsencode(part)))
        return (
            f"found a name of {len(os.fsencode(longest))} bytes in a path of {len(os.fsencode(path))}, expected at "
            f"most {_LONGEST_NAME} in one of at most 4095"
        )
    if number == errno.ELOOP:
        return "found a link in its place, expected none"
    if number in (errno.ENOTDIR, errno.ENOENT, errno.EEXIST, errno.EISDIR):
        return _in_the_way(path) or str(getattr(error, "strerror", error))
    if isinstance(error, ValueError):
        return f"found {path.name!r:.60}, which is no file's name ({error})"
    return str(getattr(error, "strerror", None) or error)


def _room(path: Path) -> str:
    for folder in path.absolute().parents:
        try:
            return f" ({shutil.disk_usage(folder).free / 1e6:,.0f} MB are left for {folder})"
        except OSError:
            continue
    return ""


def _in_the_way(path: Path) -> str:
    """What is a file where a folder should be, or a folder where a file should be, or not there."""
    for above in reversed(path.absolute().parents):
        if not os.path.lexists(above):
            return f"found no folder {above}, expected one"
        if not above.is_dir():
            return f"found a file {above}, expected a folder"
    if path.is_dir():
        return "found a folder in its place, expected a file or nothing"
    return "found a file in its place, expected a folder or nothing" if path.is_file() else ""
