"""Values computed once from tensors and kept until they change."""

from collections.abc import Callable
from typing import Generic, TypeVar

import torch
from torch import Tensor

Value = TypeVar("Value")


class Prepared(Generic[Value]):
    """The last value computed, with a copy of the tensors that it was computed from.

    Tensors are compared by what they hold. Their identity misses an optimiser's step and ``load_state_dict``, and
    their version counter misses writes through ``.data``; a comparison costs a small part of a solve.

    Example:
        >>> doubled = Prepared()
        >>> x = torch.ones(1)
        >>> doubled.get((x,), lambda: 2 * x), doubled.get((x.add_(1),), lambda: 2 * x)
        (tensor([2.]), tensor([4.]))
    """

    def __init__(self) -> None:
        self._inputs: tuple[Tensor | float, ...] = ()
        self._value: Value | None = None

    def get(self, inputs: tuple[Tensor | float, ...], compute: Callable[[], Value]) -> Value:
        """The value of ``compute``, called without gradients where an input's type, device or any entry has changed."""
        if len(self._inputs) != len(inputs) or not all(map(_same, self._inputs, inputs)):
            with torch.no_grad():
                self._value = compute()
                self._inputs = tuple(x.detach().clone() if isinstance(x, Tensor) else x for x in inputs)
        return self._value  # type: ignore[return-value]


def _same(before: Tensor | float, now: Tensor | float) -> bool:
    if isinstance(before, Tensor) and isinstance(now, Tensor):
        return before.dtype == now.dtype and before.device == now.device and torch.equal(before, now)
    return type(before) is type(now) and bool(before == now)
