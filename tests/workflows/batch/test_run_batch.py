"""A batch gives the same however many processes work on it, whatever is bad in it and whenever it is stopped."""

import csv
import errno
import json
import multiprocessing
import os
import pickle
import struct
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from slow_items import WORDS, SpellJob, written_words

from torchface.errors import FileFormatError, ValueRangeError
from torchface.workflows.batch import run_batch as module
from torchface.workflows.batch.batch_items import BatchItem, ItemKind, check_for_each, find_items, is_batch
from torchface.workflows.batch.outcomes import Outcome
from torchface.workflows.batch.processes import _received, _Worker
from torchface.workflows.batch.run_batch import BatchOptions, BatchReport, run_batch

TEXTS = {"anna": "anna", "bob": "robert", "cy": "odd", "nan": "nan"}
TEXT, NONE = pickle.dumps("done"), pickle.dumps(None)


@pytest.fixture
def words(tmp_path: Path) -> Path:
    return written_words(tmp_path, TEXTS)


def run(words: Path, out: str = "out", options: BatchOptions = module.ONE_BY_ONE) -> BatchReport:
    return run_batch(SpellJob(words.parent / "log"), WORDS, find_items([words], WORDS), words.parent / out, options)


def told(outcome: Outcome) -> Outcome:
    """Without what two runs differ in."""
    return replace(
        outcome, seconds=0.0, processor_seconds=0.0, results=tuple(Path(path.name) for path in outcome.results)
    )


def test_bad_items_are_told_and_the_others_are_done(words: Path) -> None:
    report = run(words)
    assert [outcome.name for outcome in report.done] == ["anna", "bob", "cy"]
    assert "found NaN, expected a word" in report.skipped[0].error
    assert report.outcomes[2].notes == ("an odd word",)
    assert (report.out / "bob" / "word.txt").read_text() == "trebor"
    with report.summary.open() as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert (rows["bob"]["status"], rows["bob"]["letters"], rows["bob"]["half"]) == ("done", "6", "3.0000")
    assert rows["bob"]["results"] == "bob/word.txt"
    assert (rows["nan"]["status"], rows["nan"]["letters"]) == ("skipped", "")
    assert json.loads((report.out / "records" / "nan.json").read_text())["status"] == "skipped"
    assert report.contact_sheet.is_file()
    again = run(words)
    assert all(outcome.reused for outcome in again.outcomes)
    assert [told(outcome) for outcome in again.outcomes] == [
        told(replace(outcome, reused=True)) for outcome in report.outcomes
    ]
    (words / "bob.txt").write_text("bobby!")  # of the same length
    (report.out / "anna" / "word.txt").write_text("ann")
    with pytest.warns(UserWarning, match="found other content than was written"):
        changed = run(words)
    assert [outcome.name for outcome in changed.outcomes if not outcome.reused] == ["anna", "bob"]
    (report.out / "records" / "cy.json").write_text("{")
    assert [outcome.name for outcome in run(words).outcomes if not outcome.reused] == ["cy"]


def test_one_that_dies_and_one_at_the_time_limit_take_no_other_along(words: Path) -> None:
    alone = run(words, "alone")
    (words / "x.txt").write_text("dies")
    (words / "y.txt").write_text("sleeps")
    shared = run(words, "shared", BatchOptions(2, time_limit=2))
    by_name = {outcome.name: outcome for outcome in shared.outcomes}
    assert "signal 9" in by_name["x"].error
    assert by_name["y"].error == "took longer than the time limit of 2 seconds"
    assert [told(by_name[outcome.name]) for outcome in alone.outcomes] == [told(outcome) for outcome in alone.outcomes]
    for name in ("anna", "bob", "cy"):
        assert (shared.out / name / "word.txt").read_bytes() == (alone.out / name / "word.txt").read_bytes()
    (words / "x.txt").write_text("lives")
    (words / "y.txt").write_text("short")
    mended = run(words, "shared")
    assert [outcome.name for outcome in mended.outcomes if not outcome.reused] == ["x", "y"]
    assert all(outcome.done for outcome in mended.outcomes if outcome.name != "nan")


@pytest.mark.parametrize(
    "written",
    [
        struct.pack("!i", 4) + b"junk",
        struct.pack("!i", -7),
        struct.pack("!i", 2**30) + b"a line of a library\n",
        struct.pack("!i", len(TEXT)) + TEXT,
        struct.pack("!i", len(NONE)) + NONE,
        struct.pack("!i", 9) + b"half",
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="pipes of messages")
def test_a_process_that_writes_something_else_loses_its_item_alone(words: Path, written: bytes) -> None:
    ours, theirs = multiprocessing.Pipe()
    killed: list[bool] = []
    worker = _Worker(SimpleNamespace(kill=lambda: killed.append(True)), BatchItem("bob", words))
    os.write(theirs.fileno(), written)
    theirs.close()
    with ours, pytest.raises(EOFError):
        _received(ours, worker)
    assert (killed, worker.end) == ([True], "wrote what is no outcome, and was ended")


def test_a_run_that_is_stopped_goes_on_where_it_was(words: Path) -> None:
    job, found = SpellJob(words.parent / "log"), find_items([words], WORDS)

    def stop(outcome: Outcome) -> None:
        if outcome.name == "bob":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_batch(job, WORDS, found, words.parent / "out", finished=stop)
    assert run(words).outcomes[1].reused
    assert [job.attempts(name) for name in ("anna", "bob", "cy", "nan")] == [1, 1, 1, 1]


def test_a_full_disk_stops_the_run_and_what_is_finished_is_kept(words: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, data: bytes) -> None:
        if "bob" in str(path):
            try:
                raise OSError(errno.ENOSPC, "No space left on device")
            except OSError as error:
                raise FileFormatError(f"{path}: cannot be written: the disk is full") from error
        path.write_bytes(data)

    with monkeypatch.context() as patch:
        patch.setattr("slow_items.write_file", full)
        with pytest.raises(FileFormatError, match=r"disk is full; 1 of 4 words are finished and kept"):
            run(words)
    report = run(words)
    assert [outcome.reused for outcome in report.outcomes] == [True, False, False, False]
    assert [outcome.name for outcome in report.done] == ["anna", "bob", "cy"]


def test_what_a_folder_holds_of_other_kinds_is_told(tmp_path: Path) -> None:
    for name in ("a.obj", "b.ply", "c.mp4", "d.c3d", "e.mp4", "a.mtl", "a.ljson", "skin.png", ".hidden.obj"):
        (tmp_path / name).write_text("x")
    scans = ItemKind("scan", "registered", (".obj", ".ply"))
    found = find_items([tmp_path, tmp_path / "a.obj", tmp_path / "gone.obj"], scans)
    assert [item.name for item in found.items] == ["a", "b", "gone"]
    assert found.left_out == (
        f"{tmp_path}: left out 1 marker take and 2 videos (d.c3d, c.mp4, e.mp4), expected scans (.obj, .ply)",
    )
    pictures = ItemKind("picture", "seen", (".exr",))
    with pytest.raises(FileFormatError, match="no picture in the folder but 2 scans or meshes and 1 marker take"):
        find_items([tmp_path], pictures)
    odd = ItemKind("mesh", "seen", (".obj",), lambda path: path.is_file() and path.read_text() == "y")
    with pytest.raises(FileFormatError, match=r"no mesh in the folder but .* 1 file that holds no mesh"):
        find_items([tmp_path], odd)
    assert is_batch([tmp_path], scans)
    assert not is_batch([tmp_path / "a.obj"], scans)


def test_files_that_belong_to_nothing_are_named_up_to_five(tmp_path: Path) -> None:
    takes = ItemKind("take", "solved", (".c3d", ".csv"), lambda path: path.suffix == ".c3d")
    for name in ("d.c3d", "d_sites.json", "e.mp4", "rig.png", "weights.csv"):
        (tmp_path / name).write_text("x")
    (words,) = find_items([tmp_path], takes).left_out
    found = "1 video and 1 file that holds no take and 1 other file (e.mp4, weights.csv, rig.png)"
    assert words == f"{tmp_path}: left out {found}, expected takes (.c3d, .csv)"
    for name in "fghi":
        (tmp_path / f"{name}.txt").write_text("x")
    (words,) = find_items([tmp_path], takes).left_out
    assert "and 5 other files (e.mp4, weights.csv, f.txt, g.txt, h.txt, ...), expected" in words


def test_each_of_many_results_has_a_place_of_its_own() -> None:
    item = BatchItem("take1", Path("take1.c3d"))
    assert item.path_of(Path("sites/{name}.json")) == Path("sites/take1.json")
    assert item.path_of(None) is None
    check_for_each("--report", Path("reports/{name}"))
    with pytest.raises(ValueRangeError, match=r"--animation: found out\.glb.*such as \{name\}\.glb"):
        check_for_each("--animation", Path("out.glb"))


def test_options_that_make_no_sense_are_refused(words: Path) -> None:
    with pytest.raises(ValueRangeError, match="time_limit: found 0 seconds"):
        run(words, options=BatchOptions(time_limit=0))
    with pytest.raises(ValueRangeError, match="which holds words"):
        run(words, "words")
    assert sorted(path.name for path in words.iterdir()) == sorted(f"{name}.txt" for name in TEXTS)
