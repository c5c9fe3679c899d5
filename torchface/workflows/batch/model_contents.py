"""Models in the keys of a batch: by what they hold, not by what they are called."""

from __future__ import annotations

from pathlib import Path

from torchface import zoo
from torchface.errors import TorchfaceError


def model_content(name: str | Path | None) -> str | Path | None:
    """The folder or file of a model, of which a key takes the content; the name itself where there is none."""
    if name is None or Path(name).exists():
        return None if name is None else Path(name)
    try:
        return zoo.find(name)
    except TorchfaceError:  # not a model of the zoo, such as "mediapipe" or "none"
        return name
