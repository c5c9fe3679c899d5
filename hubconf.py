"""``torch.hub.load("path/to/torchface", NAME, source="local")`` gives a model of the zoo."""

from __future__ import annotations

from collections.abc import Callable as _Callable
from typing import Any as _Any

from torchface import zoo as _zoo

dependencies = ["torch", "numpy", "scipy", "safetensors", "tomli_w"]


def _entry(name: str) -> _Callable[[], _Any]:
    def load() -> _Any:
        return _zoo.get_model(name)

    record = _zoo.describe(name)
    load.__name__ = name
    load.__doc__ = f"A model of kind {record.kind!r}. Learned from: {record.data}"
    return load


globals().update({name: _entry(name) for name in _zoo.list_models()})
