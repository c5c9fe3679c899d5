"""Base of the networks that learn from pictures of faces: how they are trained, and built from what files hold."""

import inspect
from abc import abstractmethod
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from torchface.files.documents import Value
from torchface.optim import DescentRun, DescentSettings, DescentTask, descend
from torchface.progress import Progress, ValueLog, silent


class PictureNetwork(nn.Module):
    """A network that learns from pictures; its class says of which form they are."""

    @classmethod
    def fit(
        cls,
        pictures: Dataset[tuple[Tensor, ...]],
        network: Self | None = None,
        settings: DescentSettings | None = None,
        progress: Progress | None = None,
        checkpoint: Path | None = None,
        device: str | torch.device = "cpu",
        log: ValueLog | None = None,
    ) -> Self:
        """Trains a network on pictures; the running mean of its weights, in evaluation mode, on the CPU.

        Args:
            pictures: indexed by numbers (B,), such as a ``TensorDataset``; each batch is asked for by a
                ``DataLoader``'s workers. What they give, the class says.
            checkpoint: a file that is kept while it runs, and taken up by the next run with the same settings; more
                pictures may have come by then.
            log: called with what was measured, every fifty steps.
        """
        settings = settings or cls._usual_settings()
        network = network or cls.drawn(settings.seed)
        task = network._task(pictures, settings, device)
        return descend(network, task, settings, DescentRun(progress or silent, log, checkpoint, device))

    @classmethod
    def drawn(cls, seed: int) -> Self:
        """An untrained network whose weights a seed draws."""
        with torch.random.fork_rng([]):
            torch.manual_seed(seed)
            return cls()

    @property
    def config(self) -> dict[str, Any]:
        """What the constructor was given: whole numbers, numbers, or several whole ones."""
        given = {name: getattr(self, name) for name in inspect.signature(type(self)).parameters}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in given.items()}

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> Self:
        """A network for the state to be loaded into; what a config of an earlier version lacks is as usual."""
        usual = {name: one.default for name, one in inspect.signature(cls).parameters.items()}
        given = Value("config", "", config).table()
        read = {
            name: tuple(one.whole() for one in given[name].rows())
            if isinstance(usual[name], tuple)
            else given[name].number()
            if isinstance(usual[name], float)
            else given[name].whole()
            for name in usual.keys() & given.keys()
        }
        return cls(**read)

    @classmethod
    @abstractmethod
    def _usual_settings(cls) -> DescentSettings:
        """Those of a training that says nothing else."""

    @abstractmethod
    def _task(self, pictures: Dataset[Any], settings: Any, device: str | torch.device) -> DescentTask[Any]:
        """What it learns of pictures, which are checked."""
