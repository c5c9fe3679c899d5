"""Calls whose path depends on the numbers given, kept apart from what records one path for all numbers."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np
import torch

from torchface.errors import TraceError
from torchface.number_checks import as_real
from torchface.optim.full_precision import full_precision

Given = ParamSpec("Given")
Result = TypeVar("Result")


def data_dependent(instead: str) -> Callable[[Callable[Given, Result]], Callable[Given, Result]]:
    """Marks a method that iterates until a problem is solved.

    ``torch.compile`` leaves a gap in its graph for it, in which it runs as ever: what it would compile of such a
    method are dozens of pieces, for minutes. What follows one path only is refused at once: ``torch.jit.trace``,
    ``torch.export`` and the transforms of ``torch.func``. Integers become floats, NumPy's arrays tensors.

    Example:
        >>> @data_dependent("a series")
        ... def halved(x):
        ...     while x.max() > 1:
        ...         x = x / 2
        ...     return x
        >>> halved(torch.tensor([3.0])).item()
        0.75
        >>> torch.func.vmap(halved)(torch.tensor([3.0]))
        Traceback (most recent call last):
            ...
        torchface.errors.TraceError: halved: found one of torch.func's transforms...
    """

    def marked(method: Callable[Given, Result]) -> Callable[Given, Result]:
        method = full_precision(method)
        name = method.__qualname__.partition(".")[0].lstrip("_")

        @functools.wraps(method)
        def call(*args: Given.args, **kwargs: Given.kwargs) -> Result:
            if torch.compiler.is_dynamo_compiling():
                return torch.compiler.disable(method)(*args, **kwargs)
            if torch.jit.is_tracing() or torch.compiler.is_exporting():
                raise TraceError(
                    f"{name}: iterates until every problem is solved, and a trace would repeat one frame's path for "
                    f"all; expected {instead}"
                )
            if is_transformed():
                raise TraceError(
                    f"{name}: found one of torch.func's transforms, expected a batch in place of vmap, and "
                    "torch.autograd.functional.jacobian in place of jacrev"
                )
            return method(*map(_real, args), **{key: _real(value) for key, value in kwargs.items()})

        return call

    return marked


def _real(value: Any) -> Any:
    return as_real(value) if isinstance(value, torch.Tensor | np.ndarray) else value


def is_transformed() -> bool:
    """Whether one of ``torch.func``'s transforms is at work, other than within ``torch.compile``.

    Example:
        >>> torch.func.vmap(lambda x: x + is_transformed())(torch.zeros(2)).tolist(), is_transformed()
        ([1.0, 1.0], False)
    """
    # There is no public name for it.
    return not torch.compiler.is_dynamo_compiling() and torch._C._functorch.peek_interpreter_stack() is not None


def is_recorded() -> bool:
    """Whether a call becomes a graph, compiled or exported."""
    return torch.compiler.is_compiling() or torch.compiler.is_exporting()
