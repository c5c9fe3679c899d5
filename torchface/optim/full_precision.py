"""Calls that an autocast region leaves in full precision."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import torch

Given = ParamSpec("Given")
Result = TypeVar("Result")


def full_precision(method: Callable[Given, Result]) -> Callable[Given, Result]:
    """Marks a method that ``torch.autocast`` has no effect on: products of half precision would be tenths of weights
    and of millimetres off. What comes in as float16 or bfloat16, as of a layer before it, goes on as float32.
    """

    @functools.wraps(method)
    def call(*args: Given.args, **kwargs: Given.kwargs) -> Result:
        for device in ("cpu", "cuda", "mps"):
            if torch.is_autocast_enabled(device):
                with torch.autocast(device, enabled=False):
                    return call(*map(_wide, args), **{key: _wide(value) for key, value in kwargs.items()})
        return method(*args, **kwargs)

    return call


def _wide(value: Any) -> Any:
    return value.float() if getattr(value, "dtype", None) in (torch.float16, torch.bfloat16) else value
