"""Gradient descent of small networks on crops that are drawn as it goes on, with checkpoints and a running mean."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from torchface.errors import ValueRangeError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.progress import Progress

_CHECK = 200  # steps from checkpoint to checkpoint
Network = TypeVar("Network", bound=nn.Module)


@dataclass(frozen=True)
class DescentSettings:
    """How a network descends.

    Args:
        steps: of gradient descent.
        batch: crops a step.
        rate: largest learning rate, reached after a twentieth of the steps; it ends at zero as a cosine.
        decay: of the weights.
        average: share of the running mean of weights that stays in each step.
        workers: processes that draw crops.
        seed: draws crops and the first weights.
    """

    steps: int = 8000
    batch: int = 64
    rate: float = 2e-3
    decay: float = 1e-4
    average: float = 0.998
    workers: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (self.steps >= 1 and self.batch >= 2 and 0 < self.rate < 1 and 0 <= self.average < 1):
            raise ValueRangeError(
                f"network settings: found {self.steps} steps, batch {self.batch}, rate {self.rate}, average "
                f"{self.average}; expected at least 1, at least 2, (0,1), [0,1)"
            )


@dataclass(frozen=True, eq=False)
class _Batches(IterableDataset):
    """Batches of step ``first`` and on; what a step draws depends on its number alone."""

    draw: Callable[[torch.Generator], Any]
    first: int
    settings: DescentSettings

    def __iter__(self) -> Iterator[Any]:
        torch.set_num_threads(1)
        worker = get_worker_info()
        offset, stride = (0, 1) if worker is None else (worker.id, worker.num_workers)
        for step in range(self.first + offset, self.settings.steps, stride):
            yield self.draw(torch.Generator().manual_seed(1_000_003 * self.settings.seed + step))


@dataclass(frozen=True)
class KeptDescent:
    """What a run goes on from.

    Args:
        key: of all that decides the result; a checkpoint of another key is not taken up.
        file: that is kept while it runs, and taken up by the next run with the same key; none if absent.
    """

    key: str
    file: Path | None = None


def descend(
    network: Network,
    draw: Callable[[torch.Generator], Any],
    loss: Callable[[Any, float], tuple[Tensor, float]],
    settings: DescentSettings,
    what: str,
    progress: Progress,
    kept: KeptDescent,
    device: str | torch.device = "cpu",
) -> Network:
    """Trains a network by AdamW; the rate rises over a twentieth of the steps and falls as a cosine.

    Args:
        network: goes on from its weights.
        draw: a batch, of nothing but the generator.
        loss: of a batch and the share of steps done; with the mean distance from the truth, pixels, for the progress.
        settings: how many steps, and how.
        what: it does, for the progress.
        progress: called with each step and how far it is.
        kept: where a run that is killed finds what it has learned.
        device: where the network computes.

    Returns:
        The running mean of the weights, in evaluation mode, on the CPU.
    """
    network = network.to(device).to(memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    mean = {name: value.detach().clone() for name, value in network.state_dict().items()}
    optimiser = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=settings.decay)
    first = _resume(kept.file, kept.key, network, mean, optimiser)
    workers = settings.workers
    loader = DataLoader(
        _Batches(draw, first, settings), batch_size=None, num_workers=workers, prefetch_factor=4 if workers else None
    )
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
        if kept.file is not None and (step + 1) % _CHECK == 0:
            _keep(kept.file, kept.key, step + 1, network, mean, optimiser, time.monotonic() - begin)
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
