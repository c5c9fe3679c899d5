"""Frames solved, sent, recorded and shown: what was planted comes out, whatever ends the session."""

import json
import socket
import time
import tracemalloc
from collections.abc import Iterator
from multiprocessing import active_children
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from headless_chromium import until
from planted_faces import FRONTAL, JAW, SMILE, Endless, ShadeSolver, film
from received_frames import decode_frame

from torchface import BlendshapeRig, load_rig, load_take, save_rig
from torchface.capture.anybody import WebcamControls
from torchface.cli import main
from torchface.errors import FileFormatError, ValueRangeError
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.video import open_video
from torchface.io.video.video_packets import pyav
from torchface.progress import silent
from torchface.shape_names import ARKIT
from torchface.workflows.browser_app.character import load_character
from torchface.workflows.live import live_anybody, live_session
from torchface.workflows.live import recordings as recordings_module
from torchface.workflows.live.kept_takes import film_of, kept_takes, remove_take, take_file
from torchface.workflows.live.live_anybody import LiveSettings, go_live, import_recordings
from torchface.workflows.live.live_frames import LiveFrame
from torchface.workflows.live.live_session import LiveSession, Notes
from torchface.workflows.live.page_server import Preparing
from torchface.workflows.live.recordings import FrameLog, Recordings
from torchface.workflows.live.session_prompts import STEPS
from torchface.workflows.live.weight_streams import WeightStreams
from torchface.workflows.track.head_rotations import head_rotations


@pytest.fixture(scope="module")
def dome(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small character by ARKit's names."""
    path = tmp_path_factory.mktemp("character") / "dome.glb"
    save_rig(dome_rig, path)
    return path


@pytest.fixture(autouse=True)
def one_face(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing looks for faces in pictures of one shade."""


def a_session(source: Endless, folder: Path, dome: Path, told: list[str]) -> tuple[LiveSession, Recordings]:
    recordings = Recordings(folder, load_character(dome), "planted", source.video.fps)
    streams = WeightStreams((), ARKIT, source.video.fps, told.append)
    notes = Notes(told.append)
    return LiveSession(source, ShadeSolver(), streams, recordings, notes, told.append), recordings


def test_what_was_performed_is_sent_and_recorded(dome: Path, tmp_path: Path) -> None:
    jaws = [0.0, 0.25, 0.5, 0.75, 1.0]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        address = f"livelink://127.0.0.1:{receiver.getsockname()[1]}"
        settings = LiveSettings(
            str(film(tmp_path / "film.avi", jaws)), dome, None, (address, address), tmp_path / "out", page=False
        )
        report, saved = go_live(settings, print, print, ShadeSolver)
        frames = [decode_frame(receiver.recv(2048)) for _ in range(report.figures.frames)]
    assert report.figures.frames + report.dropped == len(jaws)
    assert [(take.folder, take.frames, take.error) for take in saved] == [(tmp_path / "out", len(frames), "")]
    sent = torch.stack([frame.weights for frame in frames])
    assert set(sent[:, JAW].tolist()) <= {torch.tensor(jaw).item() for jaw in jaws}
    assert float(sent[:, JAW].max()) > 0
    ours = load_take(tmp_path / "out" / "weights.csv").weights
    unreal = load_take(tmp_path / "out" / "live_link.csv")
    assert ours.names == load_rig(dome).names  # the character's own names
    torch.testing.assert_close(ours.select(["jawOpen"]).values[:, 0, 0], sent[:, JAW])
    torch.testing.assert_close(unreal.weights.values[..., 0], sent)
    # Eyes look 0.1 (right) and 0.3 (left) to the person's left: negative yaw, as Live Link Face has it; up is negative.
    turned = unreal.extras["columns"]
    assert float(turned["RightEyeYaw"][0]) == pytest.approx(-0.1)
    assert float(turned["LeftEyeYaw"][0]) == pytest.approx(-0.3)
    assert float(turned["LeftEyePitch"][0]) == pytest.approx(0.2)
    assert float(turned["HeadYaw"].abs().max()) == 0
    played = read_gltf_weights(tmp_path / "out" / "animation.glb")
    torch.testing.assert_close(played.weights.select(["jawOpen"]).values[:, 0, 0], sent[:, JAW])
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["found"] == len(frames)


def test_uneven_frames_keep_their_times(dome: Path, tmp_path: Path) -> None:
    times = 1000 + np.array([0, 0.031, 0.07, 0.35, 0.38, 0.42])
    with FrameLog(tmp_path, ARKIT) as log:
        for i, came in enumerate(times):
            log.append(came, torch.full((52,), i / 8), torch.zeros(9))
        take = log.take(30.0)
        assert take.fps == pytest.approx(5 / 0.42)
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
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["even"] is False


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
        take = log.take(1.0)
        assert take.seconds is None
        assert take.fps == 29.97
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


def test_names_of_shapes_mean_what_the_user_says(dome: Path) -> None:
    character = load_character(dome)
    first, second = character.names[:2]
    weights = torch.rand(4, 52, generator=torch.Generator().manual_seed(0))
    moved = character.renamed({first: "tongueOut", second: "", "elsewhere": "jawOpen", character.names[2]: "nonsense"})
    found, before = moved.weights(weights), character.weights(weights)
    assert torch.equal(found[:, 0], weights[:, ARKIT.index("tongueOut")])
    assert not found[:, 1].any()
    assert torch.equal(found[:, 2:], before[:, 2:])
    assert second in moved.shapes.undriven


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


def test_controls_reach_the_solver_and_reset_does_once(dome: Path, tmp_path: Path) -> None:
    session, _ = a_session(Endless(3), tmp_path, dome, [])
    solver = session._solver
    assert isinstance(solver, ShadeSolver)
    session.gain, session.smoothing = 1.5, 0.25
    session.reset()
    session.run()
    assert [told.reset for told in solver.controls] == [True, False, False]
    assert {(told.gain, told.smoothing, told.pose) for told in solver.controls} == {(1.5, 0.25, 0)}
    assert solver.intervals[0] is None
    assert solver.intervals[1:] == pytest.approx([1 / 30, 1 / 30], abs=1e-6)
    view = session.next_view(None, 0.0)
    assert float(view.solved.weights[SMILE]) == 0.25
    assert view.solved.seen


@pytest.mark.parametrize("number", [float("nan"), float("inf"), 1e308, None, "1"])
def test_numbers_of_a_page_that_are_none_change_nothing(dome: Path, tmp_path: Path, number: object) -> None:
    session, recordings = a_session(Endless(3), tmp_path, dome, [])
    plain = [0.5] * 52
    for solver, weights in (
        ({"gain": number}, {}),
        ({"smoothing": number}, {}),
        ({"pose": number}, {}),
        ({}, {"gain": [*plain[1:], number]}),
        ({}, {"dead": [*plain[1:], number]}),
        ({}, {"smoothing": [*plain[1:], number]}),
        ({}, {"centre": {"rotation": [number] * 9, "gaze": [0.0] * 4}}),
        ({}, {"centre": {"rotation": [0.0] * 9, "gaze": [number] * 4}}),
    ):
        asked = {
            "solver": {"pose": 0, "gain": 2.0, "smoothing": 0.5, **solver},
            "weights": {"gain": plain, "dead": plain, "smoothing": plain, **weights},
        }
        with pytest.raises(ValueRangeError, match="found"):
            session.asked(json.loads(json.dumps({"controls": asked})))
    session.record(True)
    session.run()
    assert recordings.finish()[0].error == ""
    assert bool(load_take(tmp_path / "live_link.csv").weights.values.isfinite().all())


def test_a_guided_calibration_asks_for_five_faces_in_ten_seconds(dome: Path, tmp_path: Path) -> None:
    told: list[str] = []
    session, _ = a_session(Endless(320), tmp_path, dome, told)
    session.calibrate()
    session.run()
    asked = [f"{i + 1} of 5: {words}" for i, words in enumerate(STEPS)]
    missed = "; ".join((STEPS[2], STEPS[3], STEPS[4]))  # the film shows a jaw alone
    assert told == [
        *asked,
        f"Calibrated, but these poses were not seen: {missed}",
        "planted has ended after 320 frames",
    ]
    solver = session._solver
    assert isinstance(solver, ShadeSolver)
    poses = torch.tensor([controls.pose for controls in solver.controls])
    assert poses[poses > 0].unique_consecutive().tolist() == [1, 2, 3, 4, 5]
    held = torch.bincount(poses, minlength=6)[1:] / 30
    assert held.tolist() == pytest.approx([1.3] * 5, abs=0.07)
    assert (poses[:20] == 0).all()  # time to get into the first
    assert (poses[302:] == 0).all()


def test_a_receiver_that_is_not_there_is_told_once_with_the_figure() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as empty:
        empty.bind(("127.0.0.1", 0))
        port = empty.getsockname()[1]
    told: list[str] = []
    with WeightStreams((f"vmc://127.0.0.1:{port}",), ARKIT, 30.0, told.append) as streams:
        for _ in range(5):
            streams.send(torch.zeros(52), torch.zeros(9))
        (note,) = streams.notes()
    assert told == [f"vmc://127.0.0.1:{port}: nobody listens there yet; sending goes on"]
    assert "of 5 frames were not received" in note


def test_the_command_plays_records_and_says_what_is_wrong(
    dome: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(live_anybody, "person_solver", ShadeSolver)
    played = film(tmp_path / "film.avi", [0.5] * 4)
    out = tmp_path / "out"
    main(["live", str(played), "--character", str(dome), "--no-page", "--calibrate", "--record", str(out), "--quiet"])
    said = capsys.readouterr()
    assert said.out.strip() == str(out)
    assert "1 of 5: Look into the camera" in said.err
    assert len(load_take(out / "live_link.csv")) >= 1
    for words, told in (
        ((played, "--to", "vmc://no-such-host.invalid"), "whose host is not known"),
        ((played, "--to", "midi://h:1"), "expected an address such as"),
        (("99",), "camera 99: cannot be opened"),
        ((tmp_path / "none.mp4",), "no such file"),
        ((played, "--size", "wide"), "expected WIDTHxHEIGHT"),
        ((played, "--seconds", "0"), "seconds"),
    ):
        with pytest.raises(SystemExit) as ended:
            main(["live", *map(str, words), "--no-page", "--character", str(dome)])
        assert ended.value.code == 2
        assert told in " ".join(capsys.readouterr().err.split())
    main(["live", "--list"])


class CountingSession:
    """A session of the webcam's graph whose state counts pictures."""

    names = ARKIT

    def __init__(self, maker: bytes | str) -> None:
        self.maker, self.state = maker, 0

    def resume(self, state: int) -> None:
        self.state = state

    def step(self, picture: np.ndarray, interval: float) -> SimpleNamespace:
        self.state += 1
        return SimpleNamespace(
            weights=torch.full((52,), float(self.state)),
            rotation=FRONTAL,
            landmarks=torch.zeros(68, 2),
            iris=torch.zeros(2, 2),
            gaze=torch.zeros(2, 2),
            calibrated=float(self.maker == b"graph"),
            beside=torch.zeros(2),
        )


def test_the_first_start_solves_by_pytorch_until_its_graph_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = tmp_path / "made"
    monkeypatch.setattr(live_anybody, "_MAKE", f"import pathlib; pathlib.Path({str(made)!r}).write_bytes(b'graph')")
    monkeypatch.setattr(live_anybody, "kept_webcam_graph", lambda: made.read_bytes() if made.exists() else None)
    monkeypatch.setattr(live_anybody, "webcam_module", lambda: "module")
    monkeypatch.setattr(live_anybody, "ModuleSession", CountingSession)
    monkeypatch.setattr(live_anybody, "WebcamSession", CountingSession)
    solver, picture = live_anybody.person_solver(silent), np.zeros((64, 64, 3), np.uint8)
    frames = [solver.step(picture, None, WebcamControls())]
    assert frames[0].calibrated == 0
    until = time.monotonic() + 60
    while not frames[-1].calibrated and time.monotonic() < until:
        time.sleep(0.01)
        frames.append(solver.step(picture, 0.01, WebcamControls()))
    assert frames[-1].calibrated == 1
    assert [float(frame.weights[0]) for frame in frames] == list(range(1, len(frames) + 1))  # nothing is begun anew
    begun = live_anybody.person_solver(silent)  # the second start
    assert begun.step(picture, None, WebcamControls()).calibrated == 1


def test_a_take_that_was_dropped_outlives_a_solver_that_cannot_be_made(
    dome: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_anybody, "built_page", lambda progress: tmp_path)
    rows, said = torch.arange(3.0)[:, None] + torch.zeros(3, 66), list[str]()
    rows[:, 1:53] = 0.5

    def unmade(preparing: Preparing) -> ShadeSolver:
        preparing.keep("mine", rows.numpy())
        raise ValueRangeError("no solver")

    settings = LiveSettings(str(film(tmp_path / "film.avi", [0.0])), dome, takes=tmp_path / "out", port=0)
    with pytest.raises(ValueRangeError, match="no solver"):
        go_live(settings, said.append, said.append, unmade)
    (kept,) = kept_takes(tmp_path / "out")
    assert (kept.name, kept.frames) == ("mine", 3)
    assert said[-1] == f"what was dropped on the page is kept in {tmp_path / 'out'}"


@pytest.mark.parametrize("begun", [True, False])
def test_a_film_that_is_being_solved_does_not_hold_up_the_end(
    dome: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begun: bool
) -> None:
    """The process that solves it ends too, and the user is told."""
    told = list[str]()
    session, _ = a_session(Endless(3), tmp_path / "take", dome, told)
    monkeypatch.setattr(live_session, "film_of", lambda folder, place: 300)
    monkeypatch.setattr(live_session, "solved_again", time.sleep)
    session.asked({"solve": "first"})
    if begun:
        until(active_children)
    began = time.monotonic()
    session.close()
    assert time.monotonic() - began < 60
    assert not active_children()
    assert told[-1] == "first: not solved again: torchface ended before; its film stays with it"
    with pytest.raises(ValueRangeError, match="found a session that is ending"):
        session.asked({"solve": "first"})
