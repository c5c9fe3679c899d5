"""``torch.hub.load("path/to/torchface", NAME, source="local")`` gives a model of the zoo."""

from __future__ import annotations

from collections.abc import Callable as _Callable
from typing import Any as _Any

from torchface import zoo as _zoo

dependencies = ["torch", "numpy", "scipy", "safetensors", "tomli_w"]


def _entry(name: str, about: str) -> _Callable[[], _Any]:
    def load() -> _Any:
        return _zoo.get_model(name)

    load.__name__ = name
    load.__doc__ = about
    return load


def _entries() -> dict[str, _Callable[[], _Any]]:
    """One a model. A damaged one says so, and raises its own error when it is asked for."""
    records = {name: _zoo.describe(name) for name in _zoo.list_models()}
    about = {name: f"A model of kind {one.kind!r}. Learned from: {one.data}" for name, one in records.items()}
    about |= {name: f"Damaged: {fault}" for name, fault in _zoo.damaged_models().items()}
    about.pop("dependencies", None)  # the list above, which torch.hub reads
    return {name: _entry(name, text) for name, text in about.items()}


globals().update(_entries())
