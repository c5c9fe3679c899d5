"""A phone as the camera: its packets move a character, are recorded and sent on; what is lost is held, then relaxes."""

import _thread
import json
import math
import socket
import struct
import threading
import time
from collections.abc import Iterator
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
from torchface.io.protocols.live_link_packets import LiveLinkPackets
from torchface.io.protocols.live_link_recordings import recorded_packets
from torchface.io.protocols.osc_messages import osc_bundles, osc_message
from torchface.io.protocols.received_face import ReceivedFace
from torchface.shape_names import ARKIT
from torchface.workflows.live import live_session, received_source
from torchface.workflows.live.live_anybody import LiveSettings, go_live
from torchface.workflows.live.live_figures import LiveFigures
from torchface.workflows.live.received_source import ReceivedSolver, ReceivedSource, ReceivedWatch
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
    thread = threading.Thread(target=send)
    thread.start()
    yield
    thread.join()


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


def test_the_status_line_says_who_sends_what_is_lost_and_that_it_ended() -> None:
    packets, said = LiveLinkPackets(ARKIT, 60.0, "iPhone"), list[str]()
    source = ReceivedSource("livelink://127.0.0.1:0")
    try:
        watch, frames = ReceivedWatch(source, said.append), source.frames()

        def shown(packet: bytes | None) -> str:
            if packet is not None:
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                    sender.sendto(packet, ("127.0.0.1", source.receiver.port))
            came, picture = next(frames)
            watch.look(picture, True, came)
            return watch.words

        assert shown(None).startswith("Waiting for a face at port")
        whole = [packets(torch.zeros(52), None)[0] for _ in range(6)]
        assert "1 not understood (found version 9" in shown(b"\x09" + whole[0][1:])
        assert shown(whole[0]).startswith("Receiving from iPhone 127.0.0.1")
        shown(whole[1])
        assert "2 lost" in shown(whole[4])
        source.heard -= 3.0
        assert "the last expression is held, then relaxes (3 s)" in shown(None)
        assert "sees no face" in shown(whole[5][: -61 * 4 - 1])
    finally:
        source.close()
    assert len(said) == len(set(said)) == 5


@contextmanager
def listening(address: str) -> Iterator[tuple[ReceivedSource, ReceivedWatch, list[str]]]:
    source, said = ReceivedSource(address), list[str]()
    try:
        yield source, ReceivedWatch(source, said.append), said
    finally:
        source.close()


def test_where_nothing_arrives_it_is_said_once_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(received_source, "own_address", lambda: "192.168.1.5")
    monkeypatch.setattr(received_source, "other_addresses", lambda: ["10.0.0.7"])
    with listening("livelink://:0") as (source, watch, said):
        at = f"port {source.receiver.port} (UDP): have the app send to 192.168.1.5"
        for now in (1000.0, 1004.9, 1005.0, 1006.0, 1100.0):
            watch.look(PICTURE, SimpleNamespace(), now)
        assert said == [
            f"Waiting for a face at {at}",
            f"For 5 seconds no packet has come to {at} (or to 10.0.0.7, whichever is in its network). A firewall on "
            "this machine may hold packets back",
        ]
        assert watch.words == said[1]


@pytest.mark.parametrize(
    ("address", "packet", "kind"),
    [
        (
            "livelink",
            osc_message("/face/jawOpen", 0.5),
            "OSC; osc://:{} receives those · 3 not understood (found version",
        ),
        ("livelink", osc_bundles([osc_message("/VMC/Ext/Blend/Apply")])[0], "VMC; vmc://:{} receives those"),
        ("osc", osc_bundles([osc_message("/VMC/Ext/Blend/Val", "A", 0.5)])[0], "VMC; vmc://:{} receives those"),
        ("osc", LiveLinkPackets(ARKIT, 60.0)(torch.zeros(52), None)[0], "Live Link Face; livelink://:{} receives"),
        ("vmc", b"mouthSmile_R-5|eyeBlink_L-10|", "iFacialMocap; ifacialmocap://:{} receives those"),
        ("livelink", b'{"a": 1}', "text ('{{\"a\": 1}}') · 3 not understood"),
        ("livelink", b"\x09\xff\x00\x01more", "bytes 09 ff 00 01 · 3 not understood"),
    ],
)
def test_packets_of_another_protocol_are_counted_and_named(address: str, packet: bytes, kind: str) -> None:
    with listening(f"{address}://127.0.0.1:0") as (source, watch, said):
        watch.look(PICTURE, SimpleNamespace(), 0.0)
        frames, port = source.frames(), source.receiver.port
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for _ in range(3):
                sender.sendto(packet, ("127.0.0.1", port))
        next(frames)
        watch.look(PICTURE, SimpleNamespace(), 5.0)
        expected = f"For 5 seconds no face has come, but packets (3) that look like {kind.format(port)}"
        assert watch.words.startswith(expected)
        assert said[-1] == watch.words
        assert source.silence.startswith("no face has come, but packets (3)")


@pytest.mark.parametrize(
    ("address", "hint"),
    [
        ("livelink://127.0.0.1:0", "which only this machine reaches; for a phone, start with livelink://:{}"),
        ("vmc://localhost:0", "which only this machine reaches; for a phone, start with vmc://:{}"),
        ("ifacialmocap://127.0.0.1:49983", "ifacialmocap://127.0.0.1:49983 is asked to send; open iFacialMocap there"),
    ],
)
def test_where_a_phone_cannot_reach_the_hint_says_what_to_type(address: str, hint: str) -> None:
    with listening(address) as (source, watch, _):
        assert watch.words.endswith(hint.format(source.receiver.port))
        assert "have the app send to" not in watch.words


def test_a_session_that_nobody_sends_to_says_so(dome: Path, tmp_path: Path) -> None:
    settings = LiveSettings("livelink://:0", dome, record=tmp_path / "out", page=False, seconds=0.3)
    report, (saved,) = go_live(settings, print, print, lambda progress: pytest.fail("no solver is needed"))
    [words] = report.lines()
    assert " s no packet has come to port " in words
    assert saved.error == "received no face, expected one"
    assert not list((tmp_path / "out").glob("*.csv"))


def test_only_the_newest_of_several_faces_is_given_unless_every_one_is_recorded() -> None:
    packets = LiveLinkPackets(ARKIT, 60.0)
    for every, expected in ((False, [0.5]), (True, [0.1, 0.2, 0.3, 0.4, 0.5])):
        source = ReceivedSource("livelink://127.0.0.1:0", every)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for i in range(1, 6):
                sender.sendto(packets(torch.full((52,), i / 10), None)[0], ("127.0.0.1", source.receiver.port))
        frames, found = source.frames(), []
        for _ in expected:
            next(frames)
            found.append(round(source.face.weights[0].item(), 3))
        source.close()
        assert found == expected
        assert source.dropped == 5 - len(expected)


def test_what_came_while_a_character_was_read_is_no_frame() -> None:
    packets = LiveLinkPackets(ARKIT, 60.0)
    with (
        listening("livelink://127.0.0.1:0") as (source, _, _),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        for i in range(1, 6):
            if i == 5:
                source.skip()
            sender.sendto(packets(torch.full((52,), i / 10), None)[0], ("127.0.0.1", source.receiver.port))
        next(source.frames())
        assert source.face.weights[0].item() == pytest.approx(0.5)
        assert source.dropped == 0


def test_weights_that_come_one_by_one_are_one_frame_of_a_recording() -> None:
    source = ReceivedSource("osc://127.0.0.1:0", every=True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for i, name in enumerate(ARKIT):
            sender.sendto(osc_message(f"/face/{name}", i / 64), ("127.0.0.1", source.receiver.port))
    next(source.frames())
    source.close()
    torch.testing.assert_close(source.face.weights, torch.arange(52) / 64)
    assert source.dropped == 0


@pytest.mark.parametrize(
    ("camera", "told"),
    [
        ("midi://:5", "expected what receives a face: livelink://:11111"),
        ("livelink://no-such-host.invalid:1", "whose host is not known"),
        ("vmc://192.0.2.1", "expected one of this machine's addresses"),
    ],
)
def test_the_command_says_what_is_wrong_with_an_address(
    camera: str, told: str, dome: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["live", camera, "--no-page", "--character", str(dome), "--seconds", "1"])
    assert ended.value.code == 2
    assert told in " ".join(capsys.readouterr().err.split())


def test_a_port_that_another_program_has_is_said(dome: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        with pytest.raises(SystemExit):
            main(["live", f"vmc://127.0.0.1:{port}", "--no-page", "--character", str(dome), "--seconds", "1"])
    assert f"another program has port {port}" in " ".join(capsys.readouterr().err.split())
