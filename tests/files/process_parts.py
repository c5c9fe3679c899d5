"""Work that processes of tests do: without an import that would take them a second."""

import os
import signal
import time
from pathlib import Path


def end_at_one(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def note_and_wait(folder: str) -> None:
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(100)
