"""A run in a forked process of a test that is killed in its middle."""

import os
import signal
from collections.abc import Callable

import torch

_SECONDS = 120  # after which a child is ended that does not come to its step


def killed(work: Callable[[Callable[..., None]], object], step: str, done: int) -> None:
    """Runs work, which is given a progress, in another process, and kills it with SIGKILL at a step of it."""

    def progress(what: str, number: int = 0, total: int = 0) -> None:
        if (what, number) == (step, done):
            os.kill(os.getpid(), signal.SIGKILL)

    process = os.fork()
    if process == 0:
        try:
            signal.alarm(_SECONDS)
            torch.set_num_threads(1)  # threads do not come along
            work(progress)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == -signal.SIGKILL
