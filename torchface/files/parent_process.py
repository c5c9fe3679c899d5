"""End of a process with the one that started it."""

import multiprocessing
import os
import threading


def end_with_parent() -> None:
    """Ends this process, which another one has spawned, as soon as that has ended, even if it was killed."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
