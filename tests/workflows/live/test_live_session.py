"""Frames solved, sent, recorded and shown: what was planted comes out, whatever ends the session."""

import json
import socket
import time
from multiprocessing import active_children
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from headless_chromium import until
from planted_faces import FRONTAL, JAW, SMILE, Endless, ShadeSolver, a_session, film
from received_frames import decode_frame

from torchface import load_rig, load_take
from torchface.capture.anybody import WebcamControls, WebcamSettings, WebcamState
from torchface.capture.anybody.webcam_state import StateLayout
from torchface.cli import main
from torchface.errors import ValueRangeError
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.landmarks.images.frame_reader.face_reader import STATE
from torchface.progress import silent
from torchface.shape_names import ARKIT
from torchface.workflows.browser_app.character import load_character
from torchface.workflows.live import live_anybody, live_session
from torchface.workflows.live.kept_takes import kept_takes
from torchface.workflows.live.live_anybody import LiveSettings, go_live
from torchface.workflows.live.page_server import Preparing
from torchface.workflows.live.session_prompts import STEPS


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
    kept = {path: path.read_bytes() for path in out.iterdir()}
    main(["live", str(played), "--character", str(dome), "--no-page", "--record", str(out), "--quiet"])
    said = capsys.readouterr()
    assert said.out.strip() == str(out / "take_2")
    assert f"{out} holds a take, which is kept: this one is recorded into {out / 'take_2'}" in said.err
    assert all(path.read_bytes() == before for path, before in kept.items())
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
    """A session of the webcam's graph whose weights count pictures."""

    names = ARKIT

    def __init__(self, maker: bytes | str) -> None:
        self.maker, self.state = maker, torch.zeros(STATE + StateLayout(0, WebcamSettings().coefficients).length)

    def resume(self, state: torch.Tensor) -> None:
        self.state = state

    def step(self, picture: np.ndarray, interval: float) -> SimpleNamespace:
        self.state = self.state.clone()
        self.state[STATE : STATE + len(ARKIT)] += 1
        return SimpleNamespace(
            weights=self.state[STATE : STATE + len(ARKIT)],
            rotation=FRONTAL,
            landmarks=torch.zeros(68, 2),
            iris=torch.zeros(2, 2),
            gaze=torch.zeros(2, 2),
            calibrated=float(self.maker == b"graph"),
            beside=torch.zeros(2),
        )


class UnseenSkin:
    """Follows no skin."""

    names = ()

    def followed(self, picture: np.ndarray, state: WebcamState, interval: float, _: WebcamControls) -> torch.Tensor:
        assert picture.shape == (64, 64, 3)
        assert interval > 0
        return state.weights


def test_the_first_start_solves_by_pytorch_until_its_graph_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = tmp_path / "made"
    monkeypatch.setattr(live_anybody, "_MAKE", f"import pathlib; pathlib.Path({str(made)!r}).write_bytes(b'graph')")
    monkeypatch.setattr(live_anybody, "kept_webcam_graph", lambda: made.read_bytes() if made.exists() else None)
    monkeypatch.setattr(live_anybody, "webcam_module", lambda: "module")
    monkeypatch.setattr(live_anybody, "skin_follower", UnseenSkin)
    monkeypatch.setattr(live_anybody, "ModuleSession", CountingSession)
    monkeypatch.setattr(live_anybody, "WebcamSession", CountingSession)
    said: list[str] = []
    solver, picture = live_anybody.person_solver(lambda step, *_: said.append(step)), np.zeros((64, 64, 3), np.uint8)
    frames = [solver.step(picture, None, WebcamControls())]
    assert frames[0].calibrated == 0
    assert solver.reader.startswith("the graph was not ready by the last frame")
    until = time.monotonic() + 60
    while not frames[-1].calibrated and time.monotonic() < until:
        time.sleep(0.01)
        frames.append(solver.step(picture, 0.01, WebcamControls()))
    assert frames[-1].calibrated == 1
    assert solver.reader.startswith("the graph is made")
    assert not [step for step in said if "is made" in step]  # which it was not yet
    assert [float(frame.weights[0]) for frame in frames] == list(range(1, len(frames) + 1))  # nothing is begun anew
    begun = live_anybody.person_solver(silent)  # the second start
    assert begun.reader == ""
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
