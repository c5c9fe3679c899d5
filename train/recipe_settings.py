"""Settings of all recipes: the same words mean the same everywhere."""

import shutil
import sys
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch

from torchface.cli.terminal import Quiet
from torchface.errors import ValueRangeError
from torchface.number_checks import LARGEST_SEED, checked_count, checked_number

CPU_ALONE = ("cpu",)
ANY_DEVICE = ("cpu", "cuda", "mps")
_MOST = 10_000_000  # of what is counted: more of it no machine holds


@dataclass(frozen=True, kw_only=True)
class RecipeSettings:
    """What the recipe does; fields are flags, and keys of a settings file.

    Args:
        out: Folder for the model, its card and pictures, the settings and the log. Its name, which is the model's, has
            letters from a to z, digits, - and _.
        seed: Decides all that is drawn, but what settings with a seed of their own draw.
        device: Where the recipe computes, such as cpu, cuda, cuda:1 or mps; if absent on a GPU where it can use one
            and there is one.
        resume: Go on where a run that was killed has stopped; --no-resume starts anew.
        licence: Under which the model may be used; what that which it has learned from allows, if absent.
        quiet: Show no progress.
    """

    out: Path = Path("models/mine")
    seed: int = 0
    device: str | None = None
    resume: bool = True
    licence: str | None = None
    quiet: Quiet = False

    devices: ClassVar[tuple[str, ...]] = CPU_ALONE
    """Kinds of devices that the recipe can compute on."""

    def __post_init__(self) -> None:
        _check_numbers(self)

    @property
    def work(self) -> Path:
        """Folder of what is not finished, beside ``out``; it goes when the run has come to its end."""
        return self.out.parent / f".{self.out.name}.training"

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folders of the models that the run makes."""
        return (self.out,)

    def forget(self) -> None:
        """Deletes what a run that was killed has left."""
        shutil.rmtree(self.work, ignore_errors=True)

    def chosen_device(self) -> torch.device:
        """The device to compute on."""
        if self.device is None:
            found = "cuda" in self.devices and torch.cuda.is_available()
            return torch.device("cuda" if found else "cpu")
        able = " or ".join(self.devices)
        try:
            device = torch.device(self.device)
        except RuntimeError:
            raise ValueRangeError(f"--device: found {self.device!r}, expected {able}, such as cuda:0") from None
        if device.type not in self.devices:
            raise ValueRangeError(f"--device: found {self.device!r}, expected {able}: this recipe knows no other")
        if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
            there = ", ".join(f"cuda:{number}" for number in range(torch.cuda.device_count())) or "no CUDA device"
            raise ValueRangeError(f"--device: found {self.device!r}, but PyTorch sees {there} here; expected cpu")
        if device.type == "mps" and not torch.backends.mps.is_available():
            raise ValueRangeError(
                f"--device: found {self.device!r}, but PyTorch sees no such device here; expected cpu"
            )
        return device


@dataclass(frozen=True, kw_only=True)
class RenderedSettings(RecipeSettings):
    """What a recipe does that learns from rendered people alone.

    Args:
        pictures: How many to render.
        held_out: Of them, of people whom it does not learn from, kept for the test.
        folder: Where pictures are kept, for other recipes too.
        ict: ICT-FaceKit's FaceXModel folder; embedded performers alone without.
        workers: Processes that render.
    """

    pictures: int = 5000
    held_out: int = 240
    folder: Path = Path("out/pictures")
    ict: Path | None = None
    seed: int = 1
    workers: int = 2

    devices: ClassVar[tuple[str, ...]] = ANY_DEVICE

    def check_count(self, part: int) -> None:
        """Refuses fewer pictures than are held out and a ``part`` more."""
        if self.pictures < self.held_out + part:
            raise ValueRangeError(
                f"--pictures: found {self.pictures}, expected {self.held_out} to hold out and {part} more at least"
            )

    def rendered_data(self, of: str = "") -> str:
        """What it learns from, for a card; ``of`` says which part of people pictures show."""
        heads = "embedded performers" if self.ict is None else "ICT-FaceKit's heads (MIT) and embedded performers"
        return f"{self.pictures} rendered pictures of {of}{heads}; no person's photograph."


def _check_numbers(settings: Any, above: str = "") -> None:
    """No number of a recipe may be negative, infinite or beyond what a machine holds, nested ones included."""
    for name, value in ((f"{above}{own.name}", getattr(settings, own.name)) for own in fields(settings)):
        if is_dataclass(value):
            _check_numbers(value, f"{name}.")
        flag = f"--{name.replace('_', '-')}"
        for number in value if isinstance(value, tuple) else (value,):
            if type(number) is int:
                checked_count(flag, number, 0, LARGEST_SEED if name.rpartition(".")[2] == "seed" else _MOST)
            elif type(number) is float:
                checked_number(flag, number)


def recipe_name(kind: type) -> str:
    """The name of the recipe that these settings are of, as ``torchface train`` knows it."""
    module = kind.__module__.rpartition(".")[2]
    return Path(sys.modules["__main__"].__file__ or "").stem if module == "__main__" else module
