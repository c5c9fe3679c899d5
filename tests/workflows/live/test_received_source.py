"""A phone as the camera: its packets move a character, are recorded and sent on; what is lost is held, then relaxes."""

import _thread
import json
import math
import signal
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from headless_chromium import until
from osc_receiver import values_by_address
from received_frames import decode_frame

from torchface import load_take
from torchface.capture.anybody import WebcamControls
from torchface.cli import main
from torchface.io.protocols.live_link_recordings import recorded_packets
from torchface.io.protocols.received_face import ReceivedFace
from torchface.shape_names import ARKIT
from torchface.workflows.live import live_session
from torchface.workflows.live.live_anybody import LiveSettings, go_live
from torchface.workflows.live.live_figures import LiveFigures
from torchface.workflows.live.received_source import ReceivedSolver, ReceivedSource
from torchface.workflows.live.session_prompts import STEPS

_LIMIT = 120.0  # seconds, of a session that the phone ends before
JAW = ARKIT.index("jawOpen")
PICTURE = np.zeros((4, 4, 3), np.uint8)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def phone(
    monkeypatch: pytest.MonkeyPatch, packets: list[bytes], port: int, said: list[str], fps: float = 120.0
) -> Iterator[None]:
    """Sends packets at a rate, beside what goes on, once the session has said that it listens, and ends that when all
    have been found."""

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not said:
                time.sleep(0.01)
            for packet in packets:
                sender.sendto(packet, ("127.0.0.1", port))
                time.sleep(1 / fps)
        until(lambda: figures[-1].found >= len(packets))  # of a busy machine that may be late
        _thread.interrupt_main()

    figures: list[LiveFigures] = []

    class Kept(LiveFigures):
        def __init__(self) -> None:
            super().__init__()
            figures.append(self)

    monkeypatch.setattr(live_session, "LiveFigures", Kept)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores interrupts
    thread = threading.Thread(target=send)
    thread.start()
    yield
    thread.join()
    signal.signal(signal.SIGINT, before)


@contextmanager
def engine() -> Iterator[tuple[int, list[bytes]]]:
    """A port that another program listens at, and the packets that come there."""
    packets, ended = list[bytes](), threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(("127.0.0.1", 0))
        listening.settimeout(0.2)

        def receive() -> None:
            while not ended.is_set():
                with suppress(TimeoutError):
                    packets.append(listening.recv(65536))

        thread = threading.Thread(target=receive)
        thread.start()
        try:
            yield int(listening.getsockname()[1]), packets
        finally:
            ended.set()
            thread.join()


def rows_of(kept: torch.Tensor, sent: torch.Tensor, within: float = 0.0) -> list[int]:
    """Which of the frames that were sent on (S,) were kept (T,), in their order."""
    rows, rest = list[int](), iter(enumerate(sent.tolist()))
    for value in kept.tolist():
        rows.append(next(row for row, other in rest if abs(other - value) <= within))
    return rows


@pytest.mark.real
def test_an_iphones_packets_move_a_character_and_are_recorded_and_sent_on(
    dome: Path, tmp_path: Path, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packets = list(recorded_packets(data / "protocols" / "live_link_debug-jawopen.gesichter"))
    port, said = free_port(), list[str]()
    with engine() as (target, came), phone(monkeypatch, packets, port, said):
        to = (f"livelink://127.0.0.1:{target}",)
        settings = LiveSettings(
            f"livelink://127.0.0.1:{port}", dome, None, to, tmp_path / "out", page=False, seconds=_LIMIT
        )
        report, (saved,) = go_live(settings, said.append, print, lambda progress: pytest.fail("no solver is needed"))
        until(lambda: len(came) == report.figures.frames)
    sent = torch.stack([decode_frame(packet).weights for packet in came])
    assert saved.error == ""
    assert report.figures.found >= len(packets)
    # From -1 to 1 in the file: below 0 the mouth is shut.
    assert float(sent[:, JAW].max()) > 0.9
    assert float(sent[:, [i for i in range(52) if i != JAW]].max()) == 0
    kept = load_take(tmp_path / "out" / "weights.csv").weights
    assert len(kept) == len(packets)  # without the time before and after them
    rows_of(kept.select(["jawOpen"]).values[:, 0, 0], sent[:, JAW])
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["source"] == f"livelink {port}"
    assert said[0] == (
        f"Waiting for a face at port {port} (UDP) of 127.0.0.1, which only this machine reaches; for a phone, start "
        f"with livelink://:{port}"
    )
    assert any(words.startswith("Receiving from LLV Default Device 127.0.0.1") for words in said)
    assert "ms from frame to packet" in report.lines()[1]


@pytest.mark.real
def test_a_performance_of_an_iphone_is_recorded_and_sent_by_two_protocols_at_once(
    dome: Path, tmp_path: Path, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In its own time; read by python-osc. Between two packets of the file seven are missing."""
    packets = list(recorded_packets(data / "protocols" / "live_link_dao.gesichter"))
    acted = torch.tensor([struct.unpack("!61f", packet[-244:]) for packet in packets])
    port, said = free_port(), list[str]()
    with engine() as (vmc, vmc_packets), engine() as (osc, osc_packets), phone(monkeypatch, packets, port, said, 60.0):
        to = (f"vmc://127.0.0.1:{vmc}", f"osc://127.0.0.1:{osc}/face")
        settings = LiveSettings(
            f"livelink://127.0.0.1:{port}", dome, None, to, tmp_path / "out", page=False, seconds=_LIMIT
        )
        report, _ = go_live(settings, said.append, print, lambda progress: pytest.fail("no solver is needed"))
    assert report.figures.found >= len(packets)
    assert report.notes == ("7 lost",)
    take = load_take(tmp_path / "out" / "live_link.csv")
    kept = take.weights.values[:, JAW, 0]
    assert float(kept.max()) == pytest.approx(float(acted[:, JAW].max()), abs=0.05)
    by_vmc, by_osc = values_by_address(vmc_packets), values_by_address(osc_packets)
    sent = torch.tensor([value for name, value in by_vmc["/VMC/Ext/Blend/Val"] if name == "jawOpen"])
    torch.testing.assert_close(sent, torch.tensor(by_osc["/face/weights/jawOpen"])[:, 0])
    assert len(kept) == len(packets)
    rows = rows_of(kept, sent, 1e-5)
    # The head turns as the phone's did: of its quaternion the part about the vertical axis.
    turned = torch.tensor([values[4] for name, *values in by_vmc["/VMC/Ext/Bone/Pos"] if name == "Head"])
    yaw = take.extras["columns"]["HeadYaw"].float()
    assert float(yaw.max()) == pytest.approx(float(acted[:, 52].max()), abs=0.02)
    assert abs(float(torch.corrcoef(torch.stack([turned[rows], yaw]))[0, 1])) > 0.99


def a_source() -> ReceivedSource:
    """A source that a test sets."""
    return SimpleNamespace(face=None, fresh=False)


def test_what_is_lost_is_held_then_relaxes_to_rest() -> None:
    source = a_source()
    solver = ReceivedSolver(source, print)
    weights = torch.zeros(52)
    weights[JAW] = 0.9
    angles = torch.tensor([0.3, 0.1, -0.2, 0.1, 0.05, 0.0, 0.15, 0.05, 0.0])
    first = solver.step(PICTURE, None, WebcamControls())
    assert not first.seen
    assert not first.fresh
    assert bool(torch.isnan(first.rotation).all())
    source.face, source.fresh = ReceivedFace(weights, angles, sent=5.25), True
    for _ in range(3):
        frame = solver.step(PICTURE, 1 / 60, WebcamControls(smoothing=0.0))
    assert (frame.seen, frame.fresh, frame.sent) == (True, True, 5.25)
    assert frame.weights[JAW].item() == pytest.approx(0.9)
    torch.testing.assert_close(frame.rotations.float(), angles, atol=1e-6, rtol=0)
    source.fresh = False
    held = [solver.step(PICTURE, 1 / 30, WebcamControls()) for _ in range(15)]
    assert {round(frame.weights[JAW].item(), 6) for frame in held} == {0.9}
    relaxed = [solver.step(PICTURE, 1 / 30, WebcamControls()) for _ in range(60)]
    jaw = [frame.weights[JAW].item() for frame in relaxed]
    assert all(later < sooner for sooner, later in pairwise(jaw))
    assert jaw[12] == pytest.approx(0.9 * math.exp(-13 / 30 / 0.4), rel=0.02)
    assert jaw[-1] < 0.01
    assert float(relaxed[-1].rotations.abs().max()) < 0.01
    assert not relaxed[-1].seen
    source.fresh = True  # it comes back
    assert solver.step(PICTURE, 1 / 60, WebcamControls()).weights[JAW] > 0.5
    source.face = ReceivedFace(torch.zeros(52), found=False)  # the app sees no face: held as if nothing came
    assert solver.step(PICTURE, 1 / 60, WebcamControls()).weights[JAW] > 0.5


def test_smoothing_calms_what_trembles_and_follows_what_moves() -> None:
    generator = torch.Generator().manual_seed(1)
    rough: dict[float, float] = {}
    for smoothing in (0.0, 0.5, 1.0):
        source, values = a_source(), []
        source.fresh = True
        solver = ReceivedSolver(source, print)
        for i in range(240):
            weights = torch.full((52,), 0.0 if i < 180 else 0.8) + 0.02 * torch.randn(52, generator=generator)
            source.face = ReceivedFace(weights)
            values.append(solver.step(PICTURE, 1 / 60, WebcamControls(smoothing=smoothing, freeze=True)).weights[JAW])
        rough[smoothing] = float(torch.stack(values[60:180]).std())
        assert values[183] > 0.6  # within 50 ms of a jump
    assert rough[1.0] < rough[0.5] < rough[0.0]
    assert rough[0.5] < 0.6 * rough[0.0]


def test_a_guided_calibration_says_which_poses_were_not_held() -> None:
    source, said = a_source(), list[str]()
    source.face, source.fresh = ReceivedFace(torch.zeros(52)), True
    solver = ReceivedSolver(source, said.append)
    for pose in (1, 2, 3, 4, 5, 0):
        for _ in range(60):
            solver.step(PICTURE, 1 / 60, WebcamControls(pose))
    assert said == [f"calibration: not held: {words}; its shapes keep their gain" for words in STEPS[1:]]
    assert solver.step(PICTURE, 1 / 60, WebcamControls(reset=True)).calibrated < 0.1


def test_a_session_that_nobody_sends_to_says_so(dome: Path, tmp_path: Path) -> None:
    settings = LiveSettings("livelink://:0", dome, record=tmp_path / "out", page=False, seconds=0.3)
    report, (saved,) = go_live(settings, print, print, lambda progress: pytest.fail("no solver is needed"))
    [words] = report.lines()
    assert " s no packet has come to port " in words
    assert saved.error == "received no face, expected one"
    assert not list((tmp_path / "out").glob("*.csv"))


@pytest.mark.parametrize(
    ("camera", "told"),
    [
        ("midi://:5", "expected what receives a face: livelink://:11111"),
        ("livelink://no-such-host.invalid:1", "whose host is not known"),
        ("vmc://192.0.2.1", "expected one of this machine's addresses"),
    ],
)
def test_the_command_says_what_is_wrong_with_an_address(
    camera: str, told: str, dome: Path, messages_of: Callable[..., str]
) -> None:
    assert told in messages_of("live", camera, "--no-page", "--character", dome, "--seconds", "1", status=2)


def test_a_port_that_another_program_has_is_said(dome: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with pytest.raises(SystemExit):
            main(["live", f"vmc://127.0.0.1:{port}", "--no-page", "--character", str(dome), "--seconds", "1"])
    assert f"another program has port {port}" in " ".join(capsys.readouterr().err.split())
