"""What every recipe does at a shell: flags to settings, training with its progress shown, what was measured printed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Protocol, TypeVar

import tyro

from torchface.cli.progress import progress_bars
from torchface.errors import TorchfaceError
from torchface.files.job_lock import job_lock
from torchface.progress import Progress


class HasOut(Protocol):
    """Settings of a recipe: they say at least where its results go."""

    @property
    def out(self) -> Path: ...


Settings = TypeVar("Settings", bound=HasOut)
Trained = TypeVar("Trained")


def run(
    settings: type[Settings],
    train: Callable[[Settings, Progress], Trained],
    description: str | None,
    lines: Callable[[Settings, Trained], Iterable[str]],
) -> None:
    """Parses flags, trains, prints; a mistake of the user ends it with one line.

    Args:
        settings: the recipe's dataclass; ``out`` is held for this run.
        train: learns, evaluates and saves.
        description: of the recipe, for ``--help``.
        lines: what is printed of the settings and the trained model.
    """
    chosen = tyro.cli(settings, description=description)
    try:
        with job_lock(chosen.out), progress_bars() as progress:
            trained = train(chosen, progress)
        for line in lines(chosen, trained):
            print(line)
    except TorchfaceError as error:
        sys.exit(str(error))


def metric_lines(metrics: Mapping[str, float], number: str = "8.3f") -> list[str]:
    """A line for each measured number, in the given format."""
    width = max(map(len, metrics), default=0)
    return [f"{name:{width}} {value:{number}}" for name, value in metrics.items()]
