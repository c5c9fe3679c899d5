"""Several receivers at once: each has its rate and its names, and one that is dead slows none."""

import socket
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from osc_receiver import OscReceiver, values_by_address
from received_frames import decode_frame

from torchface.errors import NameMismatchError, ValueRangeError
from torchface.io.protocols import weight_sender
from torchface.shape_names import ARKIT
from torchface.workflows.live import weight_streams
from torchface.workflows.live.weight_streams import WeightStreams, mapped_sender

JAW = ARKIT.index("jawOpen")


def drained(receiver: socket.socket, count: int) -> list[bytes]:
    """So many packets, which a busy machine may deliver late, and those that came after them."""
    receiver.settimeout(10)
    packets = [receiver.recv(4096) for _ in range(count)]
    receiver.settimeout(0.2)
    with suppress(TimeoutError):
        while True:
            packets.append(receiver.recv(4096))
    return packets


def test_each_receiver_has_a_rate_of_its_own_and_a_dead_one_slows_none(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)
    monkeypatch.setattr(weight_sender, "time", clock)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as fast,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as slow,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as dead,
    ):
        for one in (fast, slow, dead):
            one.bind(("127.0.0.1", 0))
        ports = [one.getsockname()[1] for one in (fast, slow, dead)]
        dead.close()
        addresses = (
            f"livelink://127.0.0.1:{ports[0]}",
            f"livelink://127.0.0.1:{ports[1]}?rate=20",
            f"vmc://127.0.0.1:{ports[2]}",
            "vts://127.0.0.1:9",
        )
        said: list[str] = []
        with WeightStreams(addresses, ARKIT, 60.0, said.append) as streams:
            took = []
            for frame in range(60):
                clock.now = frame / 60
                before = time.perf_counter()
                streams.send(torch.full((52,), frame / 64), torch.zeros(9))
                took.append(time.perf_counter() - before)
            notes = streams.notes()
        frames = [decode_frame(packet) for packet in drained(fast, 60)]
        assert [frame.weights[JAW].item() for frame in frames] == [i / 64 for i in range(60)]
        sent = [round(64 * decode_frame(packet).weights[JAW].item()) for packet in drained(slow, 21)]
        assert sent == [0, 1, *range(3, 60, 3)]  # of 60 a second 20, and one that is early
        assert max(took) < 0.25
        assert any("nobody listens there yet" in words for words in said)
        assert any(note.startswith("vts://127.0.0.1:9: 60 of 60 frames") for note in notes)


def test_a_mapping_table_gives_a_receiver_names_of_its_own(receiver: OscReceiver, tmp_path: Path) -> None:
    table = tmp_path / "map.toml"
    table.write_text(
        '[Mund_auf]\nsum = {jawOpen = 0.5}\n["Lachen"]\nsum = {mouthSmileLeft = 0.5, mouthSmileRight = 0.5}\n'
    )
    weights = torch.zeros(52)
    weights[JAW] = 1.0
    address = f"vmc://127.0.0.1:{receiver.port}?rate=30&map={table}"
    with WeightStreams((address,), ARKIT, 60.0, print) as streams:
        streams.send(weights, torch.zeros(9))
    clips = {v[0]: v[1] for a, v in receiver.receive("/VMC/Ext/Blend/Apply") if a == "/VMC/Ext/Blend/Val"}
    assert clips == {"Mund_auf": 0.5, "Lachen": 0.0}
    sender = mapped_sender(f"osc://127.0.0.1:9/x?map={table}", ARKIT, 60.0)
    encode = sender._sender._encode
    assert "/x/weights/Mund_auf" in values_by_address(encode(torch.zeros(2), None))
    sender.close()
    with pytest.raises(NameMismatchError, match="stream: found the shapes Mund_auf, Lachen, expected some of ARKit's"):
        mapped_sender(f"ifacialmocap://127.0.0.1?map={table}", ARKIT, 60.0)
    table.write_text("[Mund_auf]\nsum = {jawOpne = 0.5}\n")
    with pytest.raises(NameMismatchError, match=r"map\.toml: .*jawOpne"):
        mapped_sender(address, ARKIT, 60.0)


def test_what_a_receiver_reports_is_said_once_each(monkeypatch: pytest.MonkeyPatch) -> None:
    class Sender:
        address, problem = "vts://h", "not connected yet"

        def send(self, weights: torch.Tensor, rotations: torch.Tensor) -> bool:
            if self.problem == "gone":
                raise ValueRangeError("stream: cannot send")
            return False

        def close(self) -> None:
            """Nothing to close."""

    sender, said = Sender(), list[str]()
    monkeypatch.setattr(weight_streams, "open_sender", lambda *_: sender)
    with WeightStreams(("vts://h",), ARKIT, 30.0, said.append) as streams:
        for problem in ("not connected yet", "not connected yet", "waits until you allow", "gone"):
            sender.problem = problem
            streams.send(torch.zeros(52), torch.zeros(9))
        assert streams.notes() == ("vts://h: 4 of 4 frames were not received, expected a program that listens there",)
    ends = ("not connected yet", "waits until you allow", "stream: cannot send")
    assert said == [f"vts://h: {end}; sending goes on" for end in ends]


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
