"""Two runs never write into one place, however they are started, and a run that was killed holds up none."""

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path

import pytest

from torchface.errors import FileFormatError, TorchfaceError, ValueRangeError
from torchface.files.job_lock import file_lock, job_lock, within_job

Lock = Callable[[Path], AbstractContextManager[Path]]
HOLD = """
import sys, time
from pathlib import Path
from torchface.files.job_lock import file_lock, job_lock
with {lock}(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("lock", [job_lock, file_lock])
def test_another_process_is_refused_by_name_until_it_is_killed(lock: Lock, tmp_path: Path) -> None:
    out = tmp_path / "a" / "out"
    other = subprocess.Popen(
        [sys.executable, "-c", HOLD.format(lock=lock.__name__), out], stdout=subprocess.PIPE, text=True
    )
    assert other.stdout.readline() == "held\n"
    there = sorted(tmp_path.rglob("*"))
    expected = rf"another run writing into .*out \(process {other.pid} on .*\), expected none"
    with pytest.raises(ValueRangeError, match=expected), lock(out):
        pass
    assert sorted(tmp_path.rglob("*")) == there
    other.send_signal(signal.SIGKILL)
    other.wait()
    with lock(out):
        assert list(tmp_path.rglob("*.lock"))
    assert not list(tmp_path.rglob("*.lock"))


def test_a_thread_of_this_process_is_another_run(tmp_path: Path) -> None:
    def second() -> None:
        with within_job(tmp_path):
            pass

    with job_lock(tmp_path), ThreadPoolExecutor(1) as pool:
        found = pool.submit(second).exception()
    assert isinstance(found, ValueRangeError)
    assert f"process {os.getpid()} on" in str(found)


def test_a_part_enters_the_folder_of_its_job_and_no_part_within_it_does(tmp_path: Path) -> None:
    with job_lock(tmp_path):
        for _ in range(2):
            with within_job(tmp_path / "." / "new" / ".."):
                with pytest.raises(ValueRangeError, match="another run"), within_job(tmp_path):
                    pass
                with job_lock(tmp_path / "beside"):
                    pass
        with pytest.raises(ValueRangeError, match="another run"), job_lock(tmp_path):
            pass
    with within_job(tmp_path):
        pass


def test_files_of_one_folder_are_held_each_on_its_own(tmp_path: Path) -> None:
    long = "ä" * 124
    with ExitStack() as held:
        for name in ("a", "b", long):
            held.enter_context(file_lock(tmp_path / f"{name}.glb"))
        (tmp_path / "folder").mkdir()
        held.enter_context(file_lock(tmp_path / "folder"))
        with pytest.raises(ValueRangeError, match=r"a\.glb"):
            held.enter_context(file_lock(tmp_path / "a.glb"))
    assert [path.name for path in tmp_path.rglob("*")] == ["folder"]


def test_a_folder_that_was_made_for_nothing_goes_and_another_stays(tmp_path: Path) -> None:
    with pytest.raises(KeyError), job_lock(tmp_path / "a" / "b"):
        raise KeyError
    assert not list(tmp_path.iterdir())
    with job_lock(tmp_path / "a" / "b") as folder:
        (folder / "result").touch()
    assert [path.name for path in (tmp_path / "a" / "b").iterdir()] == ["result"]
    with pytest.raises(KeyError), job_lock(tmp_path):
        raise KeyError
    assert tmp_path.is_dir()


def test_what_a_planted_link_names_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("kept")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".lock").symlink_to(tmp_path / "precious")
    with pytest.raises(FileFormatError, match="cannot be written: found a link"), job_lock(tmp_path / "out"):
        pass
    assert (tmp_path / "precious").read_text() == "kept"


def test_a_file_system_without_locks_is_warned_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", fail)
    with pytest.warns(UserWarning, match="the file system has no locks"), job_lock(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_one_of_many_gets_in_at_any_time(tmp_path: Path) -> None:
    """Locks come and go with their files; never are two held at once."""
    inside: list[int] = []

    def run(number: int) -> int:
        entered = 0
        while entered < 20:
            try:
                with job_lock(tmp_path / "out") as folder:
                    inside.append(number)
                    (folder / "x").touch()
                    assert inside == [number]
                    inside.clear()
                    entered += 1
            except TorchfaceError:
                pass
        return entered

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(run, range(4))) == [20] * 4
