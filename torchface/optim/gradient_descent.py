"""Gradient descent of small networks on batches that are drawn as it goes on, with checkpoints and a running mean."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.checkpoints import checkpoint_key, read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key
from torchface.progress import Progress, ValueLog, silent

_METHOD = "gradient descent/1"
_LOGGED = 50  # steps from one logged value to the next
_FORGOTTEN = 0.98  # share of what is shown that stays in each step
Network = TypeVar("Network", bound=nn.Module)
Batch = TypeVar("Batch")


@dataclass(frozen=True)
class DescentSettings:
    """How a network descends.

    Args:
        steps: of gradient descent.
        batch: examples a step.
        rate: largest learning rate, reached after a twentieth of the steps; it ends at zero as a cosine.
        decay: of the weights.
        average: share of the running mean of weights that stays in each step.
        workers: processes that draw batches; they do not change the result.
        seed: draws batches and the first weights.
        checkpoint_every: seconds from one checkpoint to the next; they do not change the result.

    Example:
        >>> settings = DescentSettings(steps=1000, rate=0.1)
        >>> settings.rate_at(50), settings.rate_at(1000)  # at its highest, and at the end
        (0.1, 0.0)
    """

    steps: int = 8000
    batch: int = 64
    rate: float = 2e-3
    decay: float = 1e-4
    average: float = 0.998
    workers: int = 0
    seed: int = 0
    checkpoint_every: float = 120.0

    def __post_init__(self) -> None:
        if not (self.steps >= 1 and self.batch >= 2 and 0 < self.rate < 1 and 0 <= self.average < 1):
            raise ValueRangeError(
                f"network settings: found {self.steps} steps, batch {self.batch}, rate {self.rate}, average "
                f"{self.average}; expected at least 1, at least 2, (0,1), [0,1)"
            )

    def rate_at(self, step: int) -> float:
        """The learning rate of a step."""
        rising = max(1.0, self.steps / 20)
        if step < rising:
            return self.rate * (step + 1) / (rising + 1)
        return self.rate * 0.5 * (1 + math.cos(math.pi * (step - rising) / max(1.0, self.steps - rising)))


@dataclass(frozen=True, eq=False)
class DescentTask(Generic[Batch]):
    """What a network learns.

    Args:
        draw: the batch of a step's number, and of nothing else.
        loss: of a batch and the share of steps done; with a number that people understand, for progress and log.
        key: of what is learned from, beside settings and network; see ``files.content_keys.content_key``.
        what: is done, for the progress.
        measure: what the number is, such as ``"pixels off"``.

    Example:
        >>> task = DescentTask(lambda step: step, lambda batch, share: (torch.zeros(()), 0.0))
        >>> task.draw(3)
        3
    """

    draw: Callable[[int], Batch]
    loss: Callable[[Batch, float], tuple[Tensor, float]]
    key: str = ""
    what: str = "learning"
    measure: str = "loss"


@dataclass(frozen=True, eq=False)
class DescentRun:
    """The folder and the reports of a descent.

    Args:
        progress: called with each step and how far it is.
        log: called with what was measured, every fifty steps.
        checkpoint: a file that is kept while it runs, and taken up by the next run of the same task, settings and
            network: that ends where one that was not stopped would have ended, on a CPU to the last bit.
        device: where the network computes.

    Example:
        >>> DescentRun(device="cpu").checkpoint is None
        True
    """

    progress: Progress = silent
    log: ValueLog | None = None
    checkpoint: Path | None = None
    device: str | torch.device = "cpu"


def descend(
    network: Network, task: DescentTask[Batch], settings: DescentSettings | None = None, run: DescentRun | None = None
) -> Network:
    """Trains a network by AdamW; the rate rises over a twentieth of the steps and falls as a cosine.

    Args:
        network: goes on from its weights.
        task: what it learns.
        settings: how many steps, and how.
        run: its folder and reports.

    Returns:
        The running mean of the weights, in evaluation mode, on the CPU.

    Raises:
        FileFormatError: the checkpoint is of another task, network or other settings.

    Example:
        >>> line = torch.nn.Linear(1, 1)
        >>> def draw(step):
        ...     return torch.randn(16, 1, generator=torch.Generator().manual_seed(step))
        >>> def loss(inputs, share):
        ...     total = (line(inputs) - 3 * inputs).square().mean()
        ...     return total, float(total.detach())
        >>> found = descend(line, DescentTask(draw, loss), DescentSettings(300, 16, 0.1, average=0.9))
        >>> bool((found.weight - 3).abs() < 0.1)
        True
    """
    settings, run = settings or DescentSettings(), run or DescentRun()
    device = torch.device(run.device)
    network = network.to(device).to(memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    mean = {name: value.detach().clone() for name, value in network.state_dict().items()}
    optimiser = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=settings.decay)
    key = _key(network, task, settings)
    cuda = [device] if device.type == "cuda" else []
    with torch.random.fork_rng(cuda):  # what a network draws itself, as in dropout, is the run's own
        torch.manual_seed(settings.seed)
        first, shown = _resume(run.checkpoint, key, network, mean, optimiser)
        workers = settings.workers
        loader = DataLoader(
            _Batches(task.draw, first, settings.steps),
            batch_size=None,
            num_workers=workers,
            prefetch_factor=4 if workers else None,
            generator=torch.Generator(),  # or it would draw from the network's own
        )
        kept = time.monotonic()
        for step, batch in enumerate(loader, first):
            for group in optimiser.param_groups:
                group["lr"] = settings.rate_at(step)
            total, number = task.loss(batch, step / settings.steps)
            optimiser.zero_grad()
            total.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
            optimiser.step()
            _average(mean, network, min(settings.average, (1 + step) / (10 + step)))
            shown = number if math.isnan(shown) else _FORGOTTEN * shown + (1 - _FORGOTTEN) * number
            done = step + 1
            run.progress(f"{task.what}, {shown:.2f} {task.measure}", done, settings.steps)
            if run.log is not None and (done % _LOGGED == 0 or done == settings.steps):
                run.log(done, task.measure, shown)
                run.log(done, "learning rate", settings.rate_at(step))
            due = time.monotonic() - kept >= settings.checkpoint_every
            if run.checkpoint is not None and due and done < settings.steps:
                write_checkpoint(run.checkpoint, _state(done, shown, network, mean, optimiser), key)
                kept = time.monotonic()
    network.load_state_dict(mean)
    return network.to("cpu").to(memory_format=torch.contiguous_format).eval()  # type: ignore[call-overload]


@dataclass(frozen=True, eq=False)
class _Batches(IterableDataset[Batch]):
    """Batches of step ``first`` and on; what a step draws depends on its number alone."""

    draw: Callable[[int], Batch]
    first: int
    steps: int

    def __iter__(self) -> Iterator[Batch]:
        worker = get_worker_info()
        if worker is not None:
            torch.set_num_threads(1)
        offset, stride = (0, 1) if worker is None else (worker.id, worker.num_workers)
        for step in range(self.first + offset, self.steps, stride):
            yield self.draw(step)


def _key(network: nn.Module, task: DescentTask[Batch], settings: DescentSettings) -> str:
    """Of all that decides the result."""
    names = ("steps", "batch", "rate", "decay", "average", "seed")
    how = {name: getattr(settings, name) for name in names}
    forms = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    return content_key(_METHOD, task=task.key, settings=how, network=forms)


@torch.no_grad()
def _average(mean: dict[str, Tensor], network: nn.Module, keep: float) -> None:
    for name, value in network.state_dict().items():
        if value.is_floating_point():
            mean[name].lerp_(value, 1 - keep)
        else:
            mean[name].copy_(value)


def _state(
    step: int, shown: float, network: nn.Module, mean: dict[str, Tensor], optimiser: torch.optim.Optimizer
) -> dict[str, Tensor]:
    """All that goes on changing, by name; the learning rate is a function of the step."""
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    tensors |= {f"mean.{name}": value for name, value in mean.items()}
    for number, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{number}.{name}": torch.as_tensor(value) for name, value in state.items()}
    tensors |= {"random.cpu": torch.get_rng_state()}
    device = next(iter(mean.values())).device
    if device.type == "cuda":
        tensors |= {"random.cuda": torch.cuda.get_rng_state(device)}
    return tensors | {"step": torch.tensor(step), "shown": torch.tensor(shown, dtype=torch.float64)}


def _resume(
    path: Path | None, key: str, network: nn.Module, mean: dict[str, Tensor], optimiser: torch.optim.Optimizer
) -> tuple[int, float]:
    """Takes up a checkpoint, if there is one; the step to go on with, and the number shown then."""
    if path is not None and checkpoint_key(path) not in (None, key):
        raise FileFormatError(
            f"{path}: found a checkpoint of other data or settings, or of another version; expected one of these; "
            "remove it to start anew"
        )
    found = None if path is None else read_checkpoint(path, key)
    if found is None:
        return 0, math.nan
    network.load_state_dict({name: found[f"network.{name}"] for name in network.state_dict()})
    for name, value in mean.items():
        value.copy_(found[f"mean.{name}"])
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in found.items():
        if name.startswith("optimiser."):
            _, number, field_name = name.split(".")
            state.setdefault(int(number), {})[field_name] = value
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
    torch.set_rng_state(found["random.cpu"])
    device = next(iter(mean.values())).device
    if device.type == "cuda" and "random.cuda" in found:
        torch.cuda.set_rng_state(found["random.cuda"], device)
    return int(found["step"]), float(found["shown"])
