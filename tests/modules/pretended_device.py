"""A second device for machines that have one: what goes wrong on a GPU goes wrong on it.

It holds its numbers on the CPU, takes no part in any operation with tensors of the CPU, and is reached only by who asks
for it.
"""

import contextlib
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

# Operations that take tensors of two devices: copies, and those that pick rows by numbers on the CPU.
_MIXING = {"aten::_to_copy", "aten::copy_", "aten::index.Tensor", "aten::index_put_", "aten::index_put"}
_FROM_NUMBERS = (torch.tensor, torch.as_tensor, torch.Tensor.new_tensor)


class Elsewhere(torch.Tensor):
    """A tensor on the pretended device."""

    numbers: Tensor

    @staticmethod
    def __new__(cls, numbers: Tensor) -> "Elsewhere":
        # Sparse ones have no strides, and pass for dense ones.
        placed = (numbers.stride(), numbers.storage_offset()) if numbers.layout == torch.strided else ()
        made = torch.Tensor._make_wrapper_subclass(cls, numbers.shape, *placed, dtype=numbers.dtype, device="meta")
        made.numbers = numbers.resolve_conj()  # whose lazy kind the wrapper would not show
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(func, args, kwargs or {})


def _computed(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    away = any(isinstance(leaf, Elsewhere) for leaf in tensors)
    name = func._schema.name
    assert all(isinstance(leaf, Elsewhere) or leaf.device.type == "cpu" for leaf in tensors), f"{name}: no numbers"
    mixing = f"{name}.{func._overloadname}" in _MIXING or name in _MIXING
    if away and not mixing and any(leaf.ndim and not isinstance(leaf, Elsewhere) for leaf in tensors):
        raise RuntimeError(f"{name}: expected all tensors to be on the same device")
    if kwargs.get("device") is not None:
        away = torch.device(kwargs["device"]).type == "meta"
        kwargs = {**kwargs, "device": torch.device("cpu")}
    found = func(*tree_map(_numbers, args), **tree_map(_numbers, kwargs))
    if tensors and found is _numbers(tensors[0]):
        return tensors[0]  # changed in place
    return tree_map(lambda x: Elsewhere(x) if away and isinstance(x, Tensor) else x, found)


def _numbers(x: Any) -> Any:
    return x.numbers if isinstance(x, Elsewhere) else x


def _row_numbers(rows: list[Any] | range) -> Tensor:
    return torch.tensor(list(rows)) if len(rows) else torch.zeros(0, dtype=torch.int64)


class _Dispatch(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(func, args, kwargs or {})


class _Numbers(TorchFunctionMode):
    """Tensors made of Python's numbers, and the way back, which pass by the dispatcher."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.Tensor.tolist:
            return args[0].cpu().tolist()
        if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__):
            key = args[1] if isinstance(args[1], tuple) else (args[1],)
            rows = (_row_numbers(part) if isinstance(part, list | range) else part for part in key)
            return func(args[0], tuple(rows), *args[2:])
        if func not in _FROM_NUMBERS:
            return func(*args, **kwargs)
        device = kwargs.pop("device", None)
        if func is torch.Tensor.new_tensor:
            device, args, kwargs = device or args[0].device, args[1:], {"dtype": args[0].dtype, **kwargs}
        made = (torch.as_tensor if func is torch.as_tensor else torch.tensor)(*args, **kwargs)
        return made if device is None else made.to(device)


@contextlib.contextmanager
def pretended() -> Iterator[str]:
    with _Dispatch(), _Numbers():
        yield "meta"
