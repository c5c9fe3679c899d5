"""Files under temporary names: no two alike, made and opened where no link is planted, removed after whoever died."""

import hashlib
import os
import re
import secrets
import sys
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from platform import node

_NAME = re.compile(r"\.(?P<of>.+)\.(?P<process>\d+)-(?P<machine>[0-9a-f]{8})-[0-9a-f]{8}\.part", re.DOTALL)
_LONGEST = 180  # bytes of the name that a temporary one begins with; file systems take 255 in all
_DAY = 86400
# On Windows a file is text, its line ends changed, unless it is said to be none; links are Unix's.
_PLAIN = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)


def shortened(name: str) -> str:
    """A file's name cut so that what is put round it leaves it short enough for a file system."""
    return os.fsencode(name)[:_LONGEST].decode(errors="ignore")


def temporary_name(path: Path) -> Path:
    """A name beside ``path`` that is nobody else's: of this process, drawn at random, hidden."""
    suffix = f"{os.getpid()}-{_machine()}-{secrets.token_hex(4)}"
    return path.with_name(f".{shortened(path.name)}.{suffix}.part")


def new_temporary(path: Path, mode: int = 0o666) -> tuple[int, Path]:
    """A new file under a temporary name beside ``path``, open for reading and writing: its descriptor and path."""
    while True:
        temporary = temporary_name(path)
        with suppress(FileExistsError):  # drawn before by a process of the same number that died
            return open_plain(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, mode), temporary


def open_plain(path: Path, flags: int, mode: int = 0o666) -> int:
    """A descriptor as ``os.open`` gives it; a link is not followed."""
    return os.open(path, flags | _PLAIN, mode)


def remove_left_over(folder: Path, name: str | None = None) -> None:
    """Deletes a folder's temporary files, of one ``name`` or all, whose process is dead; another machine's after a
    day."""
    begin = "." if name is None else f".{shortened(name)}."
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = _NAME.fullmatch(entry.name) if entry.name.startswith(begin) else None
            if match is None or (name is not None and match["of"] != shortened(name)):
                continue
            with suppress(OSError):
                if match["machine"] == _machine():
                    dead = not _alive(int(match["process"]))
                else:
                    dead = time.time() - entry.stat(follow_symlinks=False).st_mtime > _DAY
                if dead:
                    os.unlink(entry.path)


@cache
def _machine() -> str:
    """Eight digits of where process numbers mean what they mean here: this machine since its start, this container."""
    parts = [node()]
    for path in ("/proc/sys/kernel/random/boot_id", "/proc/self/ns/pid"):
        with suppress(OSError):
            parts.append(os.readlink(path) if os.path.islink(path) else Path(path).read_text())
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8]


if sys.platform == "win32":
    import ctypes

    def _alive(process: int) -> bool:
        query, still_active = 0x1000, 259
        handle = ctypes.windll.kernel32.OpenProcess(query, False, process)
        if not handle:
            return bool(ctypes.windll.kernel32.GetLastError() == 5)  # it is there and another user's
        code = ctypes.c_ulong()
        ctypes.windll.kernel32.GetExitCodeProcess(handle, ctypes.byref(code))
        ctypes.windll.kernel32.CloseHandle(handle)
        return code.value == still_active

else:

    def _alive(process: int) -> bool:
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return False
        except (PermissionError, OverflowError):  # another user's; no number of a process
            return True
        return True
