"""Runner of all recipes: flags and files to settings, one run at a time, log, what was measured printed."""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import torch
import tyro

from torchface import zoo
from torchface.cli.command_options import inputs_kept, one_line_each, plain_options
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import plain_errors, print_lines
from torchface.errors import TorchfaceError, ValueRangeError
from torchface.files.job_lock import job_lock
from torchface.files.model_roots import check_model_name
from torchface.files.whole_files import made_folder, make_folder
from torchface.progress import Progress, silent

from .recipe_settings import RecipeSettings, recipe_name
from .run_log import RunLog
from .settings_files import read_settings, write_settings

Settings = TypeVar("Settings", bound=RecipeSettings)
Taken = TypeVar("Taken", bound=RecipeSettings, contravariant=True)
Trained = TypeVar("Trained")
Made = TypeVar("Made", covariant=True)
_CONFIG = (
    "\n\n``--config settings.toml`` fills settings, such as an earlier run's OUT/settings.toml; flags win over it."
)


@dataclass(frozen=True, eq=False)
class Run:
    """What a recipe is given beside its settings."""

    progress: Progress  # called with each step and how far it is
    log: RunLog  # called with what is measured on the way; see ValueLog
    work: Path  # folder for what a run that goes on takes up; gone when the run has come to its end
    device: torch.device  # where to compute

    @property
    def checkpoint(self) -> Path:
        """File for the state of a descent."""
        return self.work / "checkpoint.safetensors"


class Train(Protocol[Taken, Made]):
    """Learns, evaluates and saves."""

    def __call__(self, settings: Taken, progress: Progress | None = None) -> Made: ...


def recipe(body: Callable[[Settings, Run], Trained]) -> Train[Settings, Trained]:
    """Makes a recipe's function one of settings and progress: the run's device, folders and log are prepared for it.

    When it has come to its end, ``settings.toml``, ``log.csv`` (what was measured on the way, and of the model) and
    ``curves.png`` lie beside the model.
    """

    @wraps(body)
    def train(settings: Settings, progress: Progress | None = None) -> Trained:
        with _running(settings, progress or silent) as run:
            return body(settings, run)

    return train  # type: ignore[return-value]


@contextmanager
def _running(settings: RecipeSettings, progress: Progress) -> Iterator[Run]:
    for folder in (settings.out, *settings.folders):  # else refused after all the work, when the model is saved
        check_model_name(folder)
    device = settings.chosen_device()
    if not settings.resume:
        settings.forget()
    log = RunLog(settings.out, goes_on=settings.work.is_dir())
    with made_folder(settings.work) as work:
        if fresh := not (begun := work / "settings.toml").is_file():  # a run that is refused leaves the killed one's
            write_settings(begun, settings)
        try:
            yield Run(progress, log, work, device)
        finally:
            if fresh and list(work.iterdir()) == [begun]:  # nothing that a run could go on from
                begun.unlink()
    if (settings.out / "model.toml").is_file():
        step = log.rows[-1].step if log.rows else 0
        for name, value in zoo.describe(settings.out.resolve()).metrics.items():
            log(step, name, value)
    log.close()
    write_settings(make_folder(settings.out) / "settings.toml", settings)
    settings.forget()


@dataclass(frozen=True)
class Recipe(Generic[Settings, Trained]):
    """A recipe as a command.

    Args:
        settings: its dataclass; ``out`` is held for this run.
        description: for ``--help``.
        lines: what is printed of the settings and the trained model; what was measured, as its card has it, if absent.
    """

    settings: type[Settings]
    train: Train[Settings, Trained]
    description: str | None
    lines: Callable[[Settings, Trained], Iterable[str]] = lambda settings, _: metric_lines(
        zoo.describe(settings.out.resolve()).metrics
    )

    def __post_init__(self) -> None:
        plain_options(self.settings)

    def main(self, arguments: Sequence[str] | None = None) -> None:
        """Parses flags, trains, prints; a mistake of the user ends it with one line and status 2."""
        with plain_errors():
            chosen = self.chosen(list(sys.argv[1:] if arguments is None else arguments))
            kept = inputs_kept(self.settings, vars(chosen))
            with kept, job_lock(chosen.out), progress_bars(chosen.quiet) as progress:
                try:
                    trained = self.train(chosen, progress)
                except KeyboardInterrupt:
                    if chosen.work.is_dir():
                        line = f"{chosen.work} keeps what was done: the same command goes on from there"
                        print_lines([f"{line}, with --no-resume it starts anew"])
                    raise
                except TorchfaceError as error:
                    name, _, rest = str(error).partition(": ")
                    if name not in vars(chosen) or is_dataclass(vars(chosen)[name]):
                        raise
                    raise type(error)(f"--{name.replace('_', '-')}: {rest}") from error  # what the library calls it
            for line in self.lines(chosen, trained):
                print(line)
            print(f"written to {' and '.join(map(str, chosen.folders))}")

    def chosen(self, words: Sequence[str]) -> Settings:
        """The settings of flags and, behind ``--config``, of a file; flags win."""
        flags = list(words)
        default: Settings | None = None
        for place, word in enumerate(flags):
            if word == "--config" or word.startswith("--config="):
                given = word.partition("=")[2] or "".join(flags[place + 1 : place + 2])
                if not given or given.startswith("--"):
                    raise ValueRangeError("--config: found no file, expected --config FILE")
                default = read_settings(Path(given), self.settings)
                del flags[place : place + (1 if "=" in word else 2)]
                break
        text = one_line_each(((self.description or "") + _CONFIG).replace("``", "`"))
        name = f"torchface train {recipe_name(self.settings)}"
        try:
            if default is None:
                return tyro.cli(self.settings, prog=name, description=text, args=flags)
            return tyro.cli(self.settings, prog=name, description=text, args=flags, default=default)
        except TorchfaceError as error:
            raise type(error)(_naming_flags(str(error), flags)) from None


def _naming_flags(message: str, words: Sequence[str]) -> str:
    """A message of settings within settings, which do not know their flags, with those that the user gave."""
    given = [word.partition("=")[0].replace("_", "-") for word in words if word.startswith("--")]
    nested = [flag for flag in given if "." in flag]
    name = message.partition(":")[0]
    if not nested or any(flag in message for flag in given):
        return message
    own = next((flag for flag in nested if flag.rpartition(".")[2] == name.replace("_", "-")), None)
    return f"{', '.join(nested)}: {message}" if own is None else own + message.removeprefix(name)


def metric_lines(metrics: Mapping[str, float], number: str = "8.3f") -> list[str]:
    """A line for each measured number, in the given format; counts without decimals."""
    width = max(map(len, metrics), default=0)
    counts = [value >= 1 and value == int(value) and "%" not in number for value in metrics.values()]
    formats = [number.split(".")[0] + ".0f" if count else number for count in counts]
    return [f"{name:{width}} {value:{form}}" for (name, value), form in zip(metrics.items(), formats, strict=True)]
