"""A marker take solved frame by frame, in its own time, and sent on as it is solved."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.io.live_link_stream import LiveLinkSender
from torchface.onnx.live import LiveMarkerSolver


@dataclass(frozen=True, eq=False)
class StreamReport:
    """What was sent.

    Args:
        weights: of each frame, (T,N).
        latency: from the frame's markers to its packet on the way, (T,), milliseconds.
    """

    weights: Tensor
    latency: Tensor

    def lines(self) -> list[str]:
        """For people to read."""
        worst = float(self.latency.quantile(0.99))
        return [
            f"{len(self.weights)} frames sent, {float(self.latency.median()):.2f} ms from markers to packet "
            f"(99th percentile {worst:.2f} ms)"
        ]


def stream_markers(
    solver: LiveMarkerSolver,
    frames: Iterable[Tensor],
    fps: float,
    address: str,
    clock: Callable[[], float] = time.perf_counter,
    wait: Callable[[float], None] = time.sleep,
) -> StreamReport:
    """Solves frames one at a time and sends each at its time.

    Args:
        solver: for these markers.
        frames: (M,3) each, millimetres, NaN for not seen; from a take or as they come in.
        fps: frames a second; a frame that comes too early waits, one that comes too late goes at once.
        address: ``udp://HOST:PORT``, in Live Link Face's packets.
        clock, wait: what time it is, and to let it pass, in seconds.

    Raises:
        ValueRangeError: the address is none, or there was no frame.
    """
    solved, latency = [], []
    with LiveLinkSender(address, solver.names, fps) as sender:
        begin = clock()
        for number, markers in enumerate(frames):
            early = begin + number / fps - clock()
            if early > 0:
                wait(early)
            came = clock()
            weights = solver.step(markers)
            sender.send(weights)
            latency.append(1000 * (clock() - came))
            solved.append(weights)
    if not solved:
        raise ValueRangeError("stream: found no frame, expected at least one")
    return StreamReport(torch.stack(solved), torch.tensor(latency))
