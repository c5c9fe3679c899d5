"""Frames of weights sent in their own time."""

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.workflows.live.weight_streams import mapped_sender


@dataclass(frozen=True, eq=False)
class StreamReport:
    """What was sent."""

    weights: Tensor  # of each frame, (T,N)
    latency: Tensor  # from when the frame was due to its packet on the way, (T,), milliseconds

    def lines(self) -> list[str]:
        """For people to read."""
        worst = float(self.latency.quantile(0.99))
        return [
            f"{len(self.weights)} frames sent, {float(self.latency.median()):.2f} ms from frame to packet "
            f"(99th percentile {worst:.2f} ms)"
        ]


def stream_weights(
    frames: Iterable[Tensor],
    names: Sequence[str],
    fps: float,
    address: str,
    clock: Callable[[], float] = time.perf_counter,
    wait: Callable[[float], None] = time.sleep,
    times: Sequence[float] | None = None,
    rotations: Tensor | None = None,
) -> StreamReport:
    """Sends frames of weights (N,), taken when they are due, at ``fps`` or at times in seconds after the first.

    ``rotations`` (T,9) are Live Link Face's of head and eyes, radians; none turn if absent.
    """
    sent: list[Tensor] = []
    latency: list[float] = []
    coming = iter(frames)
    with closing(mapped_sender(address, names, fps)) as sender:
        begin = clock()
        while True:
            row = len(sent)
            due = row / fps if times is None or row >= len(times) else times[row]
            early = begin + due - clock()
            if early > 0:
                wait(early)
            came = clock()
            weights = next(coming, None)
            if weights is None:
                break
            sender.send(weights, None if rotations is None else rotations[row])
            latency.append(1000 * (clock() - came))
            sent.append(weights)
    if not sent:
        raise ValueRangeError("stream: found no frame, expected at least one")
    return StreamReport(torch.stack(sent), torch.tensor(latency))
