"""Takes of a session: what was performed is in their files, on a disk that is full too."""

import json
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from planted_faces import Endless, ShadeSolver, a_session

from torchface import load_rig, load_take
from torchface.capture.anybody import WebcamControls
from torchface.errors import FileFormatError, MissingExtraError, ValueRangeError
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.video import open_video
from torchface.io.video.video_packets import pyav
from torchface.shape_names import ARKIT
from torchface.workflows.browser_app.character import load_character
from torchface.workflows.head_rotations import head_rotations
from torchface.workflows.live import recordings as recordings_module
from torchface.workflows.live.kept_takes import film_of, kept_takes, remove_take, take_file
from torchface.workflows.live.live_anybody import import_recordings
from torchface.workflows.live.live_frames import LiveFrame
from torchface.workflows.live.recordings import FrameLog, Recordings


def test_uneven_frames_keep_their_times(dome: Path, tmp_path: Path) -> None:
    times = 1000 + np.array([0, 0.031, 0.07, 0.35, 0.38, 0.42])
    with FrameLog(tmp_path, ARKIT) as log:
        for i, came in enumerate(times):
            log.append(came, torch.full((52,), i / 8), torch.zeros(9))
        take = log.take(30.0)
        assert take.fps == pytest.approx(4 / 0.14)  # without the gap
        seconds = take.seconds
        np.testing.assert_allclose(seconds, times - 1000, atol=1e-9)
    recordings = Recordings(tmp_path / "out", load_character(dome), "planted", 30.0)
    recordings.start()
    for i, came in enumerate(times):
        frame = ShadeSolver().step(np.full((48, 64, 3), 40 + 20 * i, np.uint8), None, WebcamControls())
        recordings.add(float(came), frame)
    recordings.finish()
    table = np.loadtxt(tmp_path / "out" / "weights.csv", delimiter=",", skiprows=1, usecols=(1,))
    np.testing.assert_allclose(table, times - 1000, atol=1e-6)
    keys = read_gltf_weights(tmp_path / "out" / "animation.glb").seconds
    np.testing.assert_allclose(keys, times - 1000, atol=1e-6)
    read = [load_take(tmp_path / "out" / name).fps for name in ("weights.csv", "live_link.csv")]
    read.append(read_gltf_weights(tmp_path / "out" / "animation.glb").fps)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [*read, summary["fps"]] == pytest.approx([4 / 0.14] * 4, rel=1e-4)
    assert summary["even"] is False


def test_a_take_without_a_face_is_not_kept(dome: Path, tmp_path: Path) -> None:
    """Its weights were zeros, which look like a face at rest."""
    recordings = Recordings(tmp_path / "out", load_character(dome), "planted", 30.0)
    recordings.start()
    for i in range(3):
        recordings.add(i / 30, LiveFrame(torch.zeros(len(ARKIT)), torch.eye(3), torch.full((68, 2), torch.nan)))
    [take] = recordings.finish()
    assert take.error == "found a face in none of its 3 frames, expected one"
    assert not list((tmp_path / "out").iterdir())


def test_even_frames_make_an_even_take(tmp_path: Path) -> None:
    with FrameLog(tmp_path, ARKIT) as log:
        for i in range(50):
            log.append(12345.678 + i / 29.97, torch.zeros(52), torch.zeros(9))
        takes = [log.take(stated) for stated in (29.97, 1.0)]
        assert [take.seconds for take in takes] == [None, None]
        assert [take.fps for take in takes] == [29.97, 30000 / 1001]  # which Live Link Face's file gives
    assert list(tmp_path.iterdir()) == []
    with FrameLog(tmp_path, ARKIT) as log, pytest.raises(ValueRangeError, match="found no frame"):
        log.take(30.0)


def test_an_interrupt_saves_what_was_recorded(dome: Path, tmp_path: Path) -> None:
    source, told = Endless(40, interrupt=True), list[str]()
    session, recordings = a_session(source, tmp_path / "out", dome, told)
    session.record(True)
    session.run()
    (take,) = recordings.finish()
    assert take.frames == 40
    kept = load_take(tmp_path / "out" / "weights.csv")
    assert len(kept) == 40
    assert kept.fps == 30.0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "animation.glb",
        "live_link.csv",
        "summary.json",
        "weights.csv",
    ]


def test_several_recordings_lie_beside_each_other(dome: Path, tmp_path: Path) -> None:
    told: list[str] = []
    session, recordings = a_session(Endless(5), tmp_path / "out", dome, told)
    for _ in range(3):
        session.record(True)
        session.run()
        session.record(False)
    session.record(False)
    assert sum("recording into" in note for note in told) == 3
    assert told.count("nothing is being recorded") == 1
    saved = recordings.finish()
    assert sorted(take.folder.relative_to(tmp_path).as_posix() for take in saved) == [
        "out",
        "out/take_2",
        "out/take_3",
    ]
    assert len(load_take(tmp_path / "out" / "take_3" / "weights.csv")) == 5


def test_two_sessions_of_one_folder_record_into_folders_of_their_own(dome: Path, tmp_path: Path) -> None:
    (first, one), (second, two) = (a_session(Endless(n), tmp_path / "out", dome, []) for n in (5, 7))
    first.record(True)
    second.record(True)
    first.run()
    second.run()
    saved = one.finish() + two.finish()
    assert [(take.folder.name, take.frames) for take in saved] == [("out", 5), ("take_2", 7)]
    assert sorted(take.frames for take in kept_takes(tmp_path / "out")) == [5, 7]


def test_a_take_is_kept_from_rows_read_again_and_imported_from_files(dome: Path, tmp_path: Path) -> None:
    told: list[str] = []
    session, recordings = a_session(Endless(1), tmp_path / "takes", dome, told)
    import_recordings(tmp_path / "new", recordings, told.append)  # the first take makes the folder
    assert not told
    generator = torch.Generator().manual_seed(0)
    head = head_rotations(0.3 * torch.randn(6, 3, generator=generator))
    parts = (torch.arange(6)[:, None] / 24, torch.rand(6, 52, generator=generator), head.flatten(1))
    rows = torch.cat([*parts, 0.2 * torch.randn(6, 4, generator=generator)], 1)
    session.keep("my part", rows.numpy())
    (kept,) = kept_takes(tmp_path / "takes")
    assert (kept.name, kept.frames, kept.filmed) == ("my part", 6, False)
    again = np.frombuffer(take_file(tmp_path / "takes", kept.place), "<f4").reshape(-1, 66)
    np.testing.assert_allclose(again, rows, atol=2e-6)
    for wrong in (rows[:0], rows.flip(0), rows * torch.nan):
        with pytest.raises(ValueRangeError, match="expected a take's rows"):
            session.keep("none", wrong.numpy())
    (tmp_path / "takes" / "phone.csv").write_bytes((tmp_path / "takes" / "live_link.csv").read_bytes())
    (tmp_path / "takes" / "notes.csv").write_text("frame,time,antenna\n0,0,1\n1,0.1,1\n")
    for _ in range(2):  # once each
        import_recordings(tmp_path / "takes", recordings, told.append)
    assert sorted(take.name for take in kept_takes(tmp_path / "takes")) == ["my part", "phone.csv"]
    left_out = [one for one in told if "left out" in one]
    assert len(left_out) == 2  # of the folder's own files none
    assert all("notes.csv: left out: take: found no weights by ARKit's names" in one for one in left_out)


def test_a_takes_film_has_its_pictures_at_their_times(dome: Path, tmp_path: Path) -> None:
    told: list[str] = []
    session, recordings = a_session(Endless(20, fps=25.0), tmp_path / "out", dome, told)
    session.record(True, filmed=True)
    session.run()
    session.asked({"record": False})
    recordings.finish()
    assert told[-2:] == ["recorded; its files are being written", f"recorded into {tmp_path / 'out'}: 20 frames"]
    (kept,) = kept_takes(tmp_path / "out")
    assert (kept.name, kept.filmed) == ("Take 1", True)
    video = open_video(film_of(tmp_path / "out", kept.place))
    assert (video.width, video.height, video.count, video.fps) == (64, 48, 20, pytest.approx(25, abs=0.1))
    shades = torch.stack([frame.float().mean() for frame in video.color_frames()])
    torch.testing.assert_close(shades, 40.0 + torch.arange(20), rtol=0, atol=3)
    remove_take(tmp_path / "out", kept.place)
    assert not (tmp_path / "out").exists()


def test_a_film_that_cannot_be_written_leaves_the_take(
    dome: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    session, recordings = a_session(Endless(20), tmp_path / "out", dome, [])
    monkeypatch.setattr(pyav(), "open", full)
    session.record(True, filmed=True)
    session.run()
    (saved,) = recordings.finish()
    assert (saved.frames, saved.error) == (20, "")
    assert "film.mp4: the film ends: [Errno 28] No space left" in saved.note
    assert not [path for path in (tmp_path / "out").iterdir() if "film" in path.name]


def test_a_full_disk_ends_the_recording_and_not_the_session(
    dome: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    session, recordings = a_session(Endless(30), tmp_path / "out", dome, told)
    session.record(True)

    def full(self: FrameLog, *_: object) -> None:
        raise FileFormatError("out: cannot be written: No space left on device")

    monkeypatch.setattr(FrameLog, "append", full)
    session.run()
    assert session.figures.frames == 30
    assert told[1] == "the recording ended: out: cannot be written: No space left on device"
    assert [take.frames for take in recordings.finish()] == [0]


def test_a_disk_that_fills_keeps_what_was_recorded(dome: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The recording ends while its files still fit: they are written, and hold less than was held free for them."""
    free = [10**12, 10**12, 10**12, 65 * 10**6]
    monkeypatch.setattr(
        recordings_module.shutil,
        "disk_usage",
        lambda path: SimpleNamespace(free=free.pop(0) if len(free) > 1 else free[0]),
    )
    told: list[str] = []
    session, recordings = a_session(Endless(600), tmp_path / "out", dome, told)
    session.record(True)
    session.run()
    assert session.figures.frames == 600
    assert "found 65 MB left, which the files of the 384 frames so far may need" in told[1]
    (saved,) = recordings.finish()
    assert (saved.frames, saved.error) == (384, "")
    assert len(load_take(tmp_path / "out" / "weights.csv")) == 384
    held_free = 384 * 24 * (63 + 2 * (len(load_rig(dome).names) + 11))
    assert sum(path.stat().st_size for path in (tmp_path / "out").iterdir()) < held_free


def test_an_animation_that_finds_no_room_leaves_the_take(
    dome: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = recordings_module.write_file

    def full(path: Path, data: bytes) -> None:
        if path.suffix == ".glb":
            raise FileFormatError(f"{path}: the disk is full")
        write(path, data)

    monkeypatch.setattr(recordings_module, "write_file", full)
    told: list[str] = []
    session, recordings = a_session(Endless(9), tmp_path / "out", dome, told)
    session.record(True)
    session.run()
    session.record(False)
    (saved,) = recordings.finish()
    missing = f"without animation.glb: {tmp_path / 'out' / 'animation.glb'}: the disk is full"
    assert (saved.frames, saved.error, saved.note) == (9, "", missing)
    assert told[-1] == f"recorded into {tmp_path / 'out'}: 9 frames; {missing}"
    assert [take.frames for take in kept_takes(tmp_path / "out")] == [9]
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["files"] == ["weights.csv", "live_link.csv"]
    assert len(take_file(tmp_path / "out", "first")) == 9 * 66 * 4


def test_a_character_whose_animation_cannot_be_made_leaves_the_take(
    dome: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> bytes:
        raise MissingExtraError("dome.glb: Draco compression needs DracoPy")

    monkeypatch.setattr(recordings_module, "performed_glb", broken)
    session, recordings = a_session(Endless(9), tmp_path / "out", dome, [])
    session.record(True)
    session.run()
    session.record(False)
    (saved,) = recordings.finish()
    missing = "without animation.glb: dome.glb: Draco compression needs DracoPy"
    assert (saved.frames, saved.error, saved.note) == (9, "", missing)
    assert len(load_take(tmp_path / "out" / "weights.csv")) == 9


def test_memory_does_not_grow_with_the_frames(dome: Path, tmp_path: Path) -> None:
    sizes: list[int] = []

    class Weighed(Endless):
        def frames(self) -> Iterator[tuple[float, np.ndarray]]:
            for number, frame in enumerate(super().frames()):
                if number == 300:  # when every window of recent frames is full
                    tracemalloc.start()
                if number in (600, 900):
                    sizes.append(tracemalloc.get_traced_memory()[0])
                yield frame

    session, recordings = a_session(Weighed(901), tmp_path / "out", dome, [])
    session.record(True)
    try:
        session.run()
    finally:
        tracemalloc.stop()
    assert sizes[1] - sizes[0] < 300 * 20  # bytes; a frame's weights alone have 208
    assert recordings.finish()[0].frames == 901
