"""Whole files in and out: refused before they fill the memory, replaced only when they are complete."""

import errno
import itertools
import os
import re
import shutil
import stat
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from shlex import quote

from torchface.errors import FileFormatError
from torchface.files.input_files import check_no_input, note_read
from torchface.files.temporary_files import new_temporary, remove_left_over, temporary_name
from torchface.files.write_errors import unmade, unsettled, unwritten

_FILES = (".csv", ".json", ".toml", ".html", ".mp4", ".mkv", ".avi",
          ".glb", ".gltf", ".obj", ".ply", ".onnx", ".png", ".jpg")  # fmt: skip
LARGEST_FILE = 2**31  # bytes; what a head rig with hundreds of shapes stays well below

_writes: dict[Path, int] = {}
_waiting: ContextVar[list[tuple[Path | None, Path]] | None] = ContextVar("waiting", default=None)


def check_there(path: Path, what: str = "file") -> None:
    """Raises ``FileFormatError`` where there is no file or folder, before its ending is judged."""
    if not path.exists():
        # As it is typed, where a program or a page that hands it over takes no quotes and escapes away as a shell does.
        bare = re.sub(r"""\\(?=[ ()&'"])""", "", str(path).strip()).strip("'\"").removeprefix("file:")
        meant = Path(os.path.expanduser(bare))  # Path.expanduser refuses a user whom nobody knows
        hint = f"; did you mean {quote(str(meant))}?" if meant != path and os.path.exists(meant) else ""
        raise FileFormatError(f"{path}: found no such {what}, expected an existing one{hint}")


def visible_files(folder: Path, endings: Collection[str] | None = None) -> list[Path]:
    """What a folder holds, with one of the endings where some are given, in order of the names; not what is hidden, as
    macOS's ``._a.obj`` and Jupyter's ``.ipynb_checkpoints``."""
    shown = (path for path in folder.iterdir() if path.name[0] != ".")
    return sorted(path for path in shown if endings is None or path.suffix.lower() in endings)


def numbered_order(path: Path) -> list[tuple[int, int, str]]:
    """Key that sorts files by name, ``frame2`` before ``frame10``."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(0, int(part[:18]), "") if part.isdecimal() else (1, 0, part) for part in parts]


def checked_size(path: Path, largest: int = LARGEST_FILE) -> int:
    """Bytes of a plain file that is there, not empty and not beyond reason."""
    try:
        check_there(path)
        if not path.is_file():
            raise FileFormatError(f"{path}: found a folder or a device, expected a plain file")
        size = path.stat().st_size
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise FileFormatError(f"{path}: cannot be read ({error})") from error
    if size == 0:
        raise FileFormatError(f"{path}: found an empty file, expected content")
    if size > largest:
        raise FileFormatError(f"{path}: found {size} bytes, expected at most {largest}")
    return size


def read_file(path: str | Path, largest: int = LARGEST_FILE) -> bytes:
    """The bytes of a file."""
    path = Path(path)
    checked_size(path, largest)
    try:
        note_read(path)
        return path.read_bytes()
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error})") from error


def write_file(path: str | Path, data: bytes) -> None:
    """Writes a file that appears only when it is complete and on the disk; see :func:`replaced_file`."""
    path = Path(path)
    with _replaced(path) as (handle, _):
        rest = memoryview(data)
        while rest:  # a system takes 2 GB at a time at most
            rest = rest[os.write(handle, rest) :]


@contextmanager
def replaced_file(path: str | Path) -> Iterator[Path]:
    """A temporary file, empty, for a writer that needs a path; it takes the place of ``path`` at the end of the block.

    Before it does it is on the disk. An error in the block, or a process that is killed, leaves what was there before.
    A file that is replaced hands on its permissions; a link in the place of ``path`` is replaced and not followed.
    """
    with _replaced(Path(path)) as (_, temporary):
        yield temporary


@contextmanager
def all_or_none() -> Iterator[None]:
    """Files written inside the block take their places together at its end.

    An error before leaves all that was there before, an error while they do brings it back. Whatever reads one of them
    inside the block finds the one before.
    """
    if (whole := _waiting.get()) is not None:  # a part of a larger whole
        begin = len(whole)
        try:
            yield
        except BaseException:
            for temporary, _ in whole[begin:]:
                if temporary is not None:
                    _delete(temporary)
            del whole[begin:]
            raise
        return
    waiting: list[tuple[Path | None, Path]] = []
    token = _waiting.set(waiting)
    try:
        try:
            yield
        finally:
            _waiting.reset(token)
        _put_in_place(waiting)
    finally:
        for temporary, _ in waiting:
            if temporary is not None:
                _delete(temporary)


def delete_file(path: Path) -> None:
    """Deletes a file where there is one; inside :func:`all_or_none` with the others."""
    check_no_input(path)
    waiting = _waiting.get()
    if waiting is not None:
        waiting.append((None, path))
        return
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be deleted ({error.strerror})") from error


@contextmanager
def made_folder(folder: str | Path) -> Iterator[Path]:
    """The folder, made with those above it where it is not there yet; what was made and stayed empty goes again."""
    folder = Path(folder)
    missing = [above for above in (folder, *folder.parents) if not os.path.lexists(above)]
    make_folder(folder)
    try:
        yield folder
    finally:
        with suppress(OSError):
            for above in missing:
                above.rmdir()


def make_folder(folder: str | Path) -> Path:
    """The folder, made with those above it where it is not there yet; none with the ending of a file."""
    folder = Path(folder)
    if folder.suffix.lower() in _FILES and not os.path.lexists(folder):
        raise FileFormatError(f"{folder}: found the name of a file, expected a folder's: several files go into it")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise unmade(folder, error) from error
    return folder


def unused(path: Path) -> Path:
    """The path where nothing is there, else the first free one of ``NAME_2``, ``NAME_3`` and so on."""
    others = (path.with_stem(f"{path.stem}_{number}") for number in itertools.count(2))
    return next(one for one in itertools.chain([path], others) if not one.exists())


def check_ending(path: str | Path, *endings: str, hint: str = "") -> None:
    """Refuses a file whose name does not end as what is written into it.

    Example:
        >>> check_ending("weights.CSV", ".csv")
        >>> check_ending("weights.xlsx", ".csv")
        Traceback (most recent call last):
            ...
        torchface.errors.FileFormatError: weights.xlsx: found the ending '.xlsx', expected .csv
    """
    suffix = Path(path).suffix
    if suffix.lower() not in endings:
        raise FileFormatError(f"{path}: found the ending {suffix!r}, expected {', '.join(endings)}{hint}")


def check_writable(*files: Path | None, folder: Path | None = None) -> None:
    """Looks whether files, or a folder for several, could be made, before long work; makes nothing."""
    for path in files:
        if path is not None:
            try:
                _permissions(path)
            except (OSError, ValueError) as error:
                raise unwritten(path, error) from error
    if folder is not None and os.path.lexists(folder) and not folder.is_dir():
        raise unwritten(folder, FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)))
    for path in (*files, folder):
        if path is None:
            continue
        above = next(parent for parent in path.absolute().parents if os.path.lexists(parent))
        if not above.is_dir() or not os.access(above, os.W_OK):
            raise FileFormatError(f"{path}: cannot be written ({above} is no folder that can be written to)")


@contextmanager
def _replaced(path: Path) -> Iterator[tuple[int, Path]]:
    check_no_input(path)
    try:
        mode = _permissions(path)
        if _is_time_to_look(path.parent):
            remove_left_over(path.parent, path.name)
        handle, temporary = new_temporary(path, 0o666 if mode is None else mode)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise unwritten(path, error) from error
    waiting = None
    try:
        try:
            yield handle, temporary
            if mode is not None and stat.S_IMODE(os.fstat(handle).st_mode) & 0o777 != mode:
                with suppress(PermissionError):  # of a mounted share: the result matters more
                    os.chmod(handle if os.chmod in os.supports_fd else temporary, mode)
            _sync(handle)
        finally:
            os.close(handle)
        waiting = _waiting.get()
        if waiting is None:
            os.replace(temporary, path)
        else:
            waiting.append((temporary, path))
    except OSError as error:
        raise unwritten(path, error) from error
    finally:
        if waiting is None:  # where it has its place already, the temporary name is gone
            _delete(temporary)
    if waiting is None:
        try:
            sync_folder(path.parent)
        except OSError as error:
            raise unsettled(path, error) from error


def _is_time_to_look(folder: Path) -> bool:
    """Whether to look for left-over files: at first always, then ever more rarely, for a look takes all its names."""
    count = _writes[folder] = _writes.get(folder, 0) + 1
    return count <= 16 or count & (count - 1) == 0


def _permissions(path: Path) -> int | None:
    """Those of the file that is there; None where there is none, or a link, which gives way."""
    try:
        status = path.lstat()
    except FileNotFoundError:
        return None
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if stat.S_ISLNK(status.st_mode):
        return None
    if not stat.S_ISREG(status.st_mode):
        raise FileFormatError(f"{path}: cannot be written: found a device or a pipe in its place, expected a file")
    return stat.S_IMODE(status.st_mode) & 0o777


def _put_in_place(waiting: list[tuple[Path | None, Path]]) -> None:
    """Renames all, or deletes where there is nothing to rename; where one cannot be, those before are as they were."""
    before: list[tuple[Path, Path | None]] = []
    path = Path()
    try:
        for temporary, path in waiting:
            before.append((path, _second_name(path)))
            if temporary is None:
                path.unlink(missing_ok=True)
            else:
                os.replace(temporary, path)
        for folder in dict.fromkeys(path.parent for _, path in waiting):
            sync_folder(folder)
    except OSError as error:
        for replaced, old in reversed(before):
            with suppress(OSError):
                if old is None:
                    replaced.unlink()
                else:
                    os.replace(old, replaced)
        raise unwritten(path, error) from error
    finally:
        for _, old in before:
            if old is not None:
                _delete(old)


def _second_name(path: Path) -> Path | None:
    """A temporary name for the file that is there as well; None where there is none."""
    if not os.path.lexists(path):
        return None
    name = temporary_name(path)
    try:
        os.link(path, name, follow_symlinks=False)
    except (OSError, NotImplementedError):  # a file system without hard links
        shutil.copy2(path, name, follow_symlinks=False)
    return name


def sync_folder(folder: Path) -> None:
    """Has the names in a folder, such as one just renamed, on the disk."""
    if sys.platform == "win32":  # folders cannot be opened there
        return
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except PermissionError:  # one may write into it and not list it
        return
    try:
        _sync(handle)
    finally:
        os.close(handle)


def _sync(handle: int) -> None:
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS):  # file systems that cannot do so
            raise


def _delete(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
