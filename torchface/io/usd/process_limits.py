"""Limits of memory, output and time that a process sets itself before it reads a file that nobody vouches for."""

import ctypes
import os
import signal
import sys
from pathlib import Path

_MEMORY_ALWAYS, _MEMORY_A_BYTE = 500 * 2**20, 20
_OUTPUT_ALWAYS, _OUTPUT_A_BYTE = 2**27, 8
_SECONDS_ALWAYS, _SECONDS_A_MEGABYTE = 5, 2
_PR_SET_PDEATHSIG = 1  # of Linux


def limit_growth(start: int, size: int) -> None:
    """Limits the memory, time and output of this process, of ``start`` bytes of addresses now, to what files of
    ``size`` bytes may take."""
    if sys.platform == "win32":  # no such limits there
        return
    import resource

    limits = {
        resource.RLIMIT_AS: start + max(_MEMORY_ALWAYS, _MEMORY_A_BYTE * size),
        resource.RLIMIT_FSIZE: max(_OUTPUT_ALWAYS, _OUTPUT_A_BYTE * size),
        resource.RLIMIT_CPU: int(_SECONDS_ALWAYS + _SECONDS_A_MEGABYTE * size / 2**20),
    }
    for kind, limit in limits.items():
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def addresses_in_use() -> int:
    """Bytes of addresses in use; those that the imports take are no file's fault."""
    status = Path("/proc/self/statm")
    if sys.platform == "win32" or not status.exists():
        return 2**40
    return int(status.read_text().split()[0]) * os.sysconf("SC_PAGESIZE")


def end_in_time(seconds: int) -> None:
    """Has the system end this process after so long, and at once when the one that started it is gone: what waits for a
    lock in C++ notices neither."""
    if sys.platform == "win32":
        return
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(seconds)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL))
