"""A frame of any rig's weights as ARKit's 52, for packets that carry these."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError
from torchface.shape_names import ARKIT, mapping


class ArkitWeights:
    """Turns weights by a rig's names into weights by ARKit's.

    Args:
        names: of the weights that come, (N,).

    Raises:
        NameMismatchError: not one name is one of ARKit's.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._matrix = mapping(names, ARKIT).float()
        if not self._matrix.any():
            raise NameMismatchError(f"stream: found the shapes {', '.join(names[:5])}, expected some of ARKit's")

    def __call__(self, weights: Tensor) -> Tensor:
        """Weights (N,) as (52,), float32; NaN becomes 0.

        Raises:
            ShapeError: another number of weights than names.
        """
        if weights.shape != self._matrix.shape[1:]:
            raise ShapeError(f"stream: found weights {tuple(weights.shape)}, expected ({self._matrix.shape[1]},)")
        return self._matrix @ weights.detach().float().cpu().nan_to_num(0.0)
