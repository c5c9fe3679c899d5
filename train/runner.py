"""What every recipe does at a shell: flags to settings, training with its progress shown, what was measured printed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import tyro

from torchface.cli.exit_messages import plain_errors
from torchface.cli.progress import progress_bars
from torchface.files.job_lock import job_lock
from torchface.progress import Progress


class HasOut(Protocol):
    """Settings of a recipe: they say at least where its results go."""

    @property
    def out(self) -> Path: ...


Settings = TypeVar("Settings", bound=HasOut)
Trained = TypeVar("Trained")


@dataclass(frozen=True)
class Recipe(Generic[Settings, Trained]):
    """A recipe as a command.

    Args:
        settings: its dataclass; ``out`` is held for this run.
        train: learns, evaluates and saves.
        description: for ``--help``.
        lines: what is printed of the settings and the trained model.
    """

    settings: type[Settings]
    train: Callable[[Settings, Progress], Trained]
    description: str | None
    lines: Callable[[Settings, Trained], Iterable[str]]

    def main(self, arguments: Sequence[str] | None = None) -> None:
        """Parses flags, trains, prints; a mistake of the user ends it with one line and status 2.

        Args:
            arguments: words of the command line; those of this process if absent.
        """
        with plain_errors():
            chosen = tyro.cli(self.settings, description=self.description, args=arguments)
            with job_lock(chosen.out), progress_bars() as progress:
                trained = self.train(chosen, progress)
            for line in self.lines(chosen, trained):
                print(line)


def metric_lines(metrics: Mapping[str, float], number: str = "8.3f") -> list[str]:
    """A line for each measured number, in the given format."""
    width = max(map(len, metrics), default=0)
    return [f"{name:{width}} {value:{number}}" for name, value in metrics.items()]
