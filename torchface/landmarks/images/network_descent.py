"""Gradient descent of small networks on crops that are drawn as it goes on, with checkpoints and a running mean."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, IterableDataset

from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.progress import Progress

_CHECK = 200  # steps from checkpoint to checkpoint
Network = TypeVar("Network", bound=nn.Module)


class DescentSettings(Protocol):
    """What a descent needs to know: steps, the largest rate, the weights' decay, the running mean's share, workers."""

    @property
    def steps(self) -> int: ...
    @property
    def rate(self) -> float: ...
    @property
    def decay(self) -> float: ...
    @property
    def average(self) -> float: ...
    @property
    def workers(self) -> int: ...


def descend(
    network: Network,
    batches: Callable[[int], IterableDataset],
    loss: Callable[[Any, float], tuple[Tensor, float]],
    settings: DescentSettings,
    key: str,
    what: str,
    progress: Progress,
    checkpoint: Path | None = None,
    device: str | torch.device = "cpu",
) -> Network:
    """Trains a network by AdamW; the rate rises over a twentieth of the steps and falls as a cosine.

    Args:
        network: goes on from its weights.
        batches: from a step's number, the batches of that step and of those after it.
        loss: of a batch and the share of steps done; with the mean distance from the truth, pixels, for the progress.
        settings: how many steps, and how.
        key: of all that decides the result; a checkpoint of another key is not taken up.
        what: it does, for the progress.
        progress: called with each step and how far it is.
        checkpoint: a file that is kept while it runs, and taken up by the next run with the same key.
        device: where the network computes.

    Returns:
        The running mean of the weights, in evaluation mode, on the CPU.
    """
    network = network.to(device).to(memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    mean = {name: value.detach().clone() for name, value in network.state_dict().items()}
    optimiser = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=settings.decay)
    first = _resume(checkpoint, key, network, mean, optimiser)
    workers = settings.workers
    loader = DataLoader(batches(first), batch_size=None, num_workers=workers, prefetch_factor=4 if workers else None)
    begin, shown = time.monotonic(), 0.0
    for step, batch in enumerate(loader, first):
        for group in optimiser.param_groups:
            group["lr"] = settings.rate * _schedule(step / settings.steps)
        total, error = loss(batch, step / settings.steps)
        optimiser.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        keep = min(settings.average, (1 + step) / (10 + step))
        with torch.no_grad():
            for name, value in network.state_dict().items():
                if value.is_floating_point():
                    mean[name].lerp_(value, 1 - keep)
                else:
                    mean[name].copy_(value)
        shown = error if not shown else 0.98 * shown + 0.02 * error
        progress(f"{what}, {shown:.2f} pixels off", step + 1, settings.steps)
        if checkpoint is not None and (step + 1) % _CHECK == 0:
            _keep(checkpoint, key, step + 1, network, mean, optimiser, time.monotonic() - begin)
    network.load_state_dict(mean)
    return network.to("cpu").to(memory_format=torch.contiguous_format).eval()  # type: ignore[call-overload]


def _schedule(share: float) -> float:
    return min(share / 0.05, 1.0) * 0.5 * (1 + math.cos(math.pi * share))


def _keep(
    path: Path,
    key: str,
    step: int,
    network: nn.Module,
    mean: dict[str, Tensor],
    optimiser: torch.optim.Optimizer,
    seconds: float,
) -> None:
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    tensors |= {f"mean.{name}": value for name, value in mean.items()}
    for number, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{number}.{name}": torch.as_tensor(value) for name, value in state.items()}
    tensors["step"] = torch.tensor(step)
    tensors["seconds"] = torch.tensor(seconds)
    write_checkpoint(path, tensors, key)


def _resume(
    path: Path | None, key: str, network: nn.Module, mean: dict[str, Tensor], optimiser: torch.optim.Optimizer
) -> int:
    """Takes up a checkpoint, if there is one of the same key; the step to go on with."""
    found = None if path is None else read_checkpoint(path, key)
    if found is None:
        return 0
    network.load_state_dict({name: found[f"network.{name}"] for name in network.state_dict()})
    for name, value in mean.items():
        value.copy_(found[f"mean.{name}"])
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in found.items():
        if name.startswith("optimiser."):
            _, number, field_name = name.split(".")
            state.setdefault(int(number), {})[field_name] = value
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
    return int(found["step"])
