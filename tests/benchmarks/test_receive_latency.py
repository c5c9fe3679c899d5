"""How long a phone's packet takes to become the packets that are sent on: median and 95th percentile, printed."""

import select
import socket
import time
from contextlib import closing

import pytest
import torch

from torchface.io.protocols.live_link_packets import LiveLinkPackets
from torchface.shape_names import ARKIT
from torchface.workflows.live.live_frames import solved_frames
from torchface.workflows.live.received_source import ReceivedSolver, ReceivedSource
from torchface.workflows.live.weight_streams import WeightStreams

FRAMES, FPS = 300, 60.0
pytestmark = pytest.mark.bench


@pytest.mark.parametrize("scheme", ["livelink", "osc", "vmc", "vrchat", "ifacialmocap"])
def test_packets_leave_soon_after_one_comes(scheme: str) -> None:
    """From a packet's sending at the phone to the last packet's arrival at the engine: decoded, corrected, smoothed."""
    generator, packets, took = torch.Generator().manual_seed(1), LiveLinkPackets(ARKIT, FPS), list[float]()
    with (
        closing(ReceivedSource("livelink://127.0.0.1:0")) as source,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as engine,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as phone,
    ):
        engine.bind(("127.0.0.1", 0))
        with WeightStreams((f"{scheme}://127.0.0.1:{engine.getsockname()[1]}",), ARKIT, FPS, print) as streams:
            solved = solved_frames(source, ReceivedSolver(source, print))
            for _ in range(FRAMES):
                (packet,) = packets(torch.rand(52, generator=generator), torch.zeros(9))
                begun = time.perf_counter()
                phone.sendto(packet, ("127.0.0.1", source.receiver.port))
                _, _, frame = next(solved)
                streams.send(frame.weights, frame.rotations)
                while select.select([engine], [], [], 0)[0]:
                    engine.recv(65536)
                    arrived = time.perf_counter()
                took.append(1000 * (arrived - begun))
                time.sleep(1 / FPS)
    milliseconds = torch.tensor(took[10:], dtype=torch.float64)  # what is made once is made
    worst = float(milliseconds.quantile(0.95))
    print(f"\n{scheme}: {float(milliseconds.median()):.2f} ms from packet to packet, 95th percentile {worst:.2f}")
    assert float(milliseconds.median()) < 1000 / FPS
