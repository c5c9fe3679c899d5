"""Card of a recipe's model: the command that makes it again, its settings, what was measured."""

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

from torchface import zoo

from .recipe_settings import RecipeSettings, recipe_name

_NOT_TOLD = ("out", "device", "resume", "seed", "quiet")  # what does not change the model, or is stated in its place


def model_card(
    settings: RecipeSettings, licence: str, data: str, metrics: Mapping[str, float], text: str
) -> zoo.ModelCard:
    """The card of a model: the command with paths as given, the effective settings with their names alone.

    Args:
        licence: under which the model may be used, where the settings do not say.
        metrics: what was measured on data held out.
        text: what the model is good for, measured how, its limits.
    """
    effective = {name: value for name, value in asdict(settings).items() if name not in ("device", "resume", "quiet")}
    return zoo.ModelCard(
        settings.licence or licence, data, metrics, command(settings), text, settings=_named(effective)
    )


def command(settings: RecipeSettings) -> str:
    """The command of these settings: what is not as by default, paths as given, the seed, and where the model goes."""
    words = ["torchface", "train", recipe_name(type(settings)), *_flags(settings, "")]
    return shlex.join([*words, "--seed", str(settings.seed), "--out", f"models/{settings.out.name}"])


def _flags(settings: Any, prefix: str) -> Iterator[str]:
    for field in fields(settings):
        value, usual = getattr(settings, field.name), field.default
        if field.default_factory is not MISSING:
            usual = field.default_factory()
        if value == usual or (not prefix and field.name in _NOT_TOLD):
            continue
        name = prefix + field.name.replace("_", "-")
        if is_dataclass(value):
            yield from _flags(value, f"{name}.")
        elif isinstance(value, bool):
            yield f"--{name}" if value else f"--{prefix}no-{field.name.replace('_', '-')}"
        else:
            yield from (f"--{name}", *map(str, value if isinstance(value, tuple) else [value]))


def _named(value: Any) -> Any:
    """As a card keeps settings: what is absent left out, of paths the names."""
    if isinstance(value, Mapping):
        return {name: _named(inner) for name, inner in value.items() if inner is not None}
    if isinstance(value, tuple):
        return [_named(inner) for inner in value]
    return value.name if isinstance(value, Path) else value
