"""Processes of recipes: a killed one is a plain error, and none outlives the run that started it."""

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from process_parts import end_at_one, note_and_wait

from torchface.errors import TorchfaceError
from train.spawned_processes import map_in_processes

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no fork")


def test_a_killed_process_is_a_plain_error() -> None:
    assert list(map_in_processes(abs, [-1, 2], 1)) == [1, 2]
    with pytest.raises(TorchfaceError, match="one of 2 processes was ended from outside"):
        list(map_in_processes(end_at_one, range(4), 2))


def test_no_process_outlives_a_killed_run(tmp_path: Path) -> None:
    run = os.fork()
    if run == 0:
        try:
            list(map_in_processes(note_and_wait, [str(tmp_path)] * 2, 2))
        finally:
            os._exit(1)
    try:
        wait_for(lambda: len(list(tmp_path.iterdir())) == 2)
        workers = [int(path.name) for path in tmp_path.iterdir()]
    finally:
        os.kill(run, signal.SIGKILL)
        os.waitpid(run, 0)
    wait_for(lambda: not any(map(is_alive, workers)))


def wait_for(fact: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not fact():
        assert time.monotonic() < end
        time.sleep(0.01)


def is_alive(number: int) -> bool:
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    return True
