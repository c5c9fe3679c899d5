"""A file is there whole or as it was before, whatever fails, dies or writes beside it."""

import errno
import os
import re
import resource
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest

from torchface.errors import FileFormatError
from torchface.files.job_lock import job_lock
from torchface.files.whole_files import (
    all_or_none,
    check_writable,
    delete_file,
    made_folder,
    make_folder,
    replaced_file,
    write_file,
)

Fault = Callable[..., object]
FULL = (
    (errno.ENOSPC, r"the disk is full \([\d,]+ MB are left for .*\); free some, or name a place on another disk"),
    (errno.EDQUOT, "the quota is used up"),
    (errno.EIO, "the disk reports an input/output error"),
    (errno.EROFS, "the file system is read-only"),
    (errno.EFBIG, r"larger than the file system or the shell's limit"),
)


def failing(number: int) -> Fault:
    def fail(*_: object, **__: object) -> object:
        raise OSError(number, os.strerror(number))

    return fail


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def before(tmp_path: Path) -> Path:
    path = tmp_path / "rig.glb"
    path.write_bytes(b"before")
    return path


@pytest.mark.parametrize(("number", "told"), FULL)
@pytest.mark.parametrize("call", ["write", "fsync", "replace"])
def test_a_failing_disk_leaves_what_was_there_and_is_told(
    before: Path, call: str, number: int, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(os, call, failing(number))
        with pytest.raises(FileFormatError, match=rf"rig\.glb: cannot be written: .*{told}.*before is unchanged"):
            write_file(before, b"after")
    assert before.read_bytes() == b"before"
    assert names(before.parent) == ["rig.glb"]


def test_a_folder_that_fails_after_the_rename_is_told_as_what_it_is(
    before: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail_for_folders(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EIO, "broken")

    monkeypatch.setattr(os, "fsync", fail_for_folders)
    with pytest.raises(FileFormatError, match=r"rig\.glb: written, and may be lost in a power cut: the disk reports"):
        write_file(before, b"after")
    assert before.read_bytes() == b"after"


def test_half_of_a_write_is_followed_by_the_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = os.write
    monkeypatch.setattr(os, "write", lambda handle, data: whole(handle, bytes(data[:1000])))
    content = os.urandom(12_345)
    write_file(tmp_path / "a", content)
    assert (tmp_path / "a").read_bytes() == content


def test_the_file_then_its_new_name_are_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    rename = os.replace

    def sync(handle: int) -> None:
        calls.append("folder" if stat.S_ISDIR(os.fstat(handle).st_mode) else f"{os.fstat(handle).st_size} bytes")

    def renamed(old: Path, new: Path) -> None:
        calls.append("rename")
        rename(old, new)

    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(os, "replace", renamed)
    write_file(tmp_path / "a", b"12345")
    assert calls == ["5 bytes", "rename", "folder"]


def test_a_full_file_system_is_told_by_the_system_itself(before: Path) -> None:
    """A limit of file size, in a process of its own, stops writes half-way as a full disk does."""
    program = (
        "import sys; from torchface.files.whole_files import *; from pathlib import Path\n"
        "from torchface.errors import FileFormatError\n"
        "for write in (lambda p: write_file(p, bytes(2**20)), ):\n"
        "    try: write(Path(sys.argv[1]))\n"
        "    except FileFormatError as error: print(error)\n"
        "try:\n"
        "    with replaced_file(sys.argv[1]) as path: path.write_bytes(bytes(2**20))\n"
        "except FileFormatError as error: print(error)\n"
    )
    limit = 2**16
    done = subprocess.run(
        [sys.executable, "-c", program, before],
        capture_output=True,
        text=True,
        check=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    told = f"{before}: cannot be written: the file would be larger than the file system or the shell's limit"
    assert [line.startswith(told) for line in done.stdout.splitlines()] == [True, True]
    assert before.read_bytes() == b"before"
    assert names(before.parent) == ["rig.glb"]


def test_1600_writes_of_16_threads_all_come_through(tmp_path: Path) -> None:
    """A hundred to each of 16 files, by all threads at once; each file is one of the contents, whole."""

    def write(number: int) -> None:
        write_file(tmp_path / str(number % 16), bytes([number // 16]) * 5000)

    with ThreadPoolExecutor(16) as pool:
        failed = [job.exception() for job in [pool.submit(write, number) for number in range(1600)]]
    assert failed == [None] * 1600
    assert len(names(tmp_path)) == 16
    for path in tmp_path.iterdir():
        content = path.read_bytes()
        assert content == content[:1] * 5000


KILLED = """
import os, sys
from pathlib import Path
from torchface.files import whole_files
os.replace = lambda *_: os.kill(os.getpid(), 9)
whole_files.write_file(Path(sys.argv[1]), b"after")
"""


@pytest.mark.parametrize("cleaned_by", ["write", "lock"])
def test_what_a_killed_process_leaves_goes_with_the_next(before: Path, cleaned_by: str) -> None:
    killed = subprocess.run([sys.executable, "-c", KILLED, before], check=False)
    assert killed.returncode == -9
    assert before.read_bytes() == b"before"
    assert len(names(before.parent)) == 2
    write_file(before.with_name("other"), b"x")
    assert len(names(before.parent)) == 3  # another file's is nobody's business here
    if cleaned_by == "write":
        write_file(before, b"after")
    else:
        with job_lock(before.parent):
            pass
    assert names(before.parent) == ["other", "rig.glb"]


def test_temporary_files_of_the_living_stay(before: Path) -> None:
    with replaced_file(before) as temporary:
        temporary.write_bytes(b"slow")
        with job_lock(before.parent):
            pass
        write_file(before, b"quick")
        other = before.with_name(".rig.glb.1-00000000-00000000.part")  # of a machine that shares the folder
        other.touch()
        write_file(before, b"quick")
        assert other.exists()
        os.utime(other, (time.time() - 90_000,) * 2)
        write_file(before, b"quick")
        assert not other.exists()
    assert before.read_bytes() == b"slow"


def test_planted_links_are_never_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    precious = tmp_path / "precious"
    precious.write_text("kept")
    out = tmp_path / "out"
    out.mkdir()
    (out / "a.csv").symlink_to(precious)
    write_file(out / "a.csv", b"new")
    assert (out / "a.csv").read_bytes() == b"new"
    assert not (out / "a.csv").is_symlink()
    tokens = iter(["0" * 8, "0" * 8, "1" * 8])
    monkeypatch.setattr("secrets.token_hex", lambda _: next(tokens))
    with replaced_file(out / "b.csv") as first:
        pass
    first.symlink_to(precious)  # whoever guesses a name beforehand
    with replaced_file(out / "b.csv") as second:
        second.write_text("new")
    assert second != first
    assert precious.read_text() == "kept"


@pytest.mark.parametrize("mode", [0o600, 0o664, 0o444, 0o755])
def test_a_file_hands_on_its_permissions_and_a_new_one_has_the_umasks(before: Path, mode: int) -> None:
    before.chmod(mode)
    write_file(before, b"after")
    assert stat.S_IMODE(before.stat().st_mode) == mode
    mask = os.umask(0o027)
    try:
        with replaced_file(before.with_name("new")) as temporary:
            temporary.write_text("new")
    finally:
        os.umask(mask)
    assert stat.S_IMODE(before.with_name("new").stat().st_mode) == 0o640


def test_a_private_file_is_never_open_to_others(before: Path) -> None:
    before.chmod(0o600)
    with replaced_file(before) as temporary:
        assert stat.S_IMODE(temporary.stat().st_mode) == 0o600


def test_names_and_places_that_do_not_work_are_told(before: Path) -> None:
    folder = before.parent
    for path, told in (
        (folder / ("n" * 300), "found a name of 300 bytes in a path of .*, expected at most 255"),
        (folder / "none" / "a.csv", "found no folder .*none, expected one"),
        (before / "a.csv", r"found a file .*rig\.glb, expected a folder"),
        (folder, "found a folder in its place, expected a file or nothing"),
        (Path(os.devnull), "found a device or a pipe in its place, expected a file"),
        (folder / "a\0b", ".*which is no file's name"),
    ):
        for write in (lambda path: write_file(path, b"x"), lambda path: replaced_file(path).__enter__()):
            with pytest.raises(FileFormatError, match=f"cannot be written: {told}"):
                write(path)
    with pytest.raises(FileFormatError, match=r"cannot be made: found a file .*rig\.glb, expected a folder"):
        make_folder(before / "a" / "b")
    with pytest.raises(FileFormatError, match="cannot be made: found a file in its place, expected a folder"):
        make_folder(before)
    with pytest.raises(FileFormatError, match="cannot be made: found a name of 300 bytes"):
        make_folder(folder / ("n" * 300))
    with pytest.raises(FileFormatError, match="found a folder in its place"):
        check_writable(folder)
    with pytest.raises(FileFormatError, match="found a file in its place, expected a folder"):
        check_writable(folder=before)
    assert names(folder) == ["rig.glb"]
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)
    longest = folder / ("ü" * 125 + ".json")
    write_file(longest, b"x")
    assert longest.read_bytes() == b"x"


def test_a_writer_that_fails_leaves_what_was_there(before: Path) -> None:
    def write() -> None:
        with replaced_file(before) as temporary:
            temporary.write_text("half")
            raise KeyError

    with pytest.raises(KeyError):
        write()
    assert before.read_bytes() == b"before"
    assert names(before.parent) == ["rig.glb"]


def test_files_of_one_whole_take_their_places_together_or_none_does(
    before: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, old = before.parent, before.with_name("old.csv")
    old.write_text("old")

    def write_all() -> None:
        with all_or_none():
            write_file(folder / "new.png", b"after")
            with all_or_none():
                delete_file(old)
            with replaced_file(before) as temporary:
                temporary.write_bytes(b"after")
            assert (names(folder)[-2:], before.read_bytes()) == (["old.csv", "rig.glb"], b"before")
            write_file(folder / "z.csv", b"after")

    rename = os.replace

    def last_fails(source: Path, target: Path) -> None:
        if target.name == "z.csv":
            raise OSError(errno.EIO, "broken")
        rename(source, target)

    for call, fault in (("replace", last_fails), ("fsync", failing(errno.ENOSPC))):
        with monkeypatch.context() as patch:
            patch.setattr(os, call, fault)
            with pytest.raises(FileFormatError, match="cannot be written"):
                write_all()
        assert (names(folder), before.read_bytes()) == (["old.csv", "rig.glb"], b"before")
        assert old.read_text() == "old"
    with monkeypatch.context() as patch:
        patch.setattr(os, "link", failing(errno.EPERM))  # a file system without hard links
        write_all()
    assert names(folder) == ["new.png", "rig.glb", "z.csv"]
    assert before.read_bytes() == b"after"


def test_a_folder_that_was_made_for_nothing_goes(tmp_path: Path) -> None:
    with pytest.raises(KeyError), made_folder(tmp_path / "a" / "b"):
        raise KeyError
    assert names(tmp_path) == []


KILLED_HALF_WAY = """
import os, sys
from pathlib import Path
from torchface.files.whole_files import all_or_none, write_file
rename = os.replace
def second_kills(source, target):
    if target.name == "b":
        os.kill(os.getpid(), 9)
    rename(source, target)
os.replace = second_kills
with all_or_none():
    for name in "abc":
        write_file(Path(sys.argv[1]) / name, b"after")
"""


def test_a_group_killed_between_two_renames_leaves_whole_files_and_the_next_run_mends_it(tmp_path: Path) -> None:
    for name in "abc":
        (tmp_path / name).write_bytes(b"before")
    assert subprocess.run([sys.executable, "-c", KILLED_HALF_WAY, tmp_path], check=False).returncode == -9
    assert [(tmp_path / name).read_bytes() for name in "abc"] == [b"after", b"before", b"before"]
    with job_lock(tmp_path), all_or_none():
        for name in "abc":
            write_file(tmp_path / name, b"after")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == dict.fromkeys("abc", b"after")


def test_nothing_in_the_library_writes_past_whole_files() -> None:
    root = Path(__file__).resolve().parents[2]
    past = re.compile(
        r"os\.re(place|name)\(|\.write_(bytes|text)\(|(?<!temporary\.)\bopen\([^)\n]*[\"'][rb]*[wax]|\.touch\(|\.mkdir\("
    )
    examples = re.compile(r"^ *(>>>|\.\.\.) .*$", re.MULTILINE)
    own = {
        "torchface/files/whole_files.py",  # whose ``replaced_file`` gives a ``temporary`` path to write to
        "torchface/io/meshes/mesh_sequence.py",  # grows in its place, as the next
        "train/run_log.py",
        "torchface/io/usd/stage_process.py",  # into a temporary folder, as what follows
        "torchface/io/usd/usd_writing.py",
        "torchface/io/blender/blender_files.py",
        "torchface/io/blender/reading_in_blender.py",
        "torchface/io/video/film_sound.py",  # into a file without a name
        "torchface/workflows/browser_app/built_page.py",  # other programs fill a folder, that then takes its place
    }
    found = {
        path.relative_to(root).as_posix()
        for folder in ("torchface", "train")
        for path in (root / folder).rglob("*.py")
        if past.search(examples.sub("", path.read_text()))
    }
    assert found == own


def test_a_part_that_fails_is_left_out_of_the_whole(tmp_path: Path) -> None:
    with all_or_none():
        write_file(tmp_path / "whole", b"1")
        with suppress(KeyError), all_or_none():
            write_file(tmp_path / "part", b"2")
            raise KeyError
    assert [path.name for path in tmp_path.iterdir()] == ["whole"]


def test_no_folder_is_made_that_is_called_as_a_file(tmp_path: Path) -> None:
    """``track film.mp4 --out weights.csv`` asks for something that is not written."""
    with pytest.raises(FileFormatError, match=r"weights\.csv: found the name of a file, expected a folder's"):
        make_folder(tmp_path / "weights.csv")
    (tmp_path / "kept.csv").mkdir()
    assert make_folder(tmp_path / "kept.csv").is_dir()
    assert make_folder(tmp_path / "take.v2").is_dir()
