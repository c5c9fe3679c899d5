"""A solved take, sent in its own time."""

import time
from collections.abc import Callable
from contextlib import closing

import torch

from torchface.io.weights.weight_csv import ROTATIONS
from torchface.take import Take
from torchface.workflows.live.weight_streams import mapped_sender


def stream_take(
    take: Take, address: str, clock: Callable[[], float] = time.perf_counter, wait: Callable[[float], None] = time.sleep
) -> str:
    """Sends each frame of a take with weights and rotations (``extras["columns"]``) at its time; what was sent, in
    words."""
    assert take.weights is not None
    turns = torch.stack([torch.as_tensor(take.extras["columns"][name]) for name in ROTATIONS], 1).float()
    why, latency = list[str](), []  # from when each frame was due to its packet on the way, milliseconds
    with closing(mapped_sender(address, take.weights.names, take.fps)) as sender:
        begin = clock()
        for weights, turn, due in zip(take.weights.values[..., 0], turns, take.times.tolist(), strict=True):
            if (early := begin + due - clock()) > 0:
                wait(early)
            came = clock()
            if not sender.send(weights, turn):
                why.append(sender.problem)
            latency.append(1000 * (clock() - came))
    typical, worst = torch.tensor(latency).quantile(torch.tensor([0.5, 0.99])).tolist()
    missed = f"; {len(why)} were not received: {why[-1]}" if why else ""
    return f"{len(latency)} frames sent, {typical:.2f} ms from frame to packet (99th percentile {worst:.2f} ms){missed}"
