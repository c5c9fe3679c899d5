"""A take's weights as the keys of a rig's animation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ValueRangeError
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping
from torchface.take import Take


@dataclass(frozen=True)
class WeightKeys:
    """Keys of an animation, linear between them.

    Args:
        seconds: of each key, (T,) float64, rising from 0.
        weights: of a rig's shapes, (T,N) float32.
        fps: frames a second of the film that they are for.
    """

    seconds: Tensor
    weights: Tensor
    fps: float


@dataclass(frozen=True)
class ShapeMatch:
    """Which of a rig's shapes a take's channels drive.

    Args:
        driven: shapes of the rig that follow a channel.
        missing: shapes of the rig that no channel drives; they stay at 0.
        unused: channels of the take that the rig has no shape for.

    Example:
        >>> match = ShapeMatch(driven=("jawOpen",), missing=("mouthClose",), unused=("tongueOut",))
        >>> f"{match.missing[0]} stays at 0, {match.unused[0]} moves nothing"
        'mouthClose stays at 0, tongueOut moves nothing'
    """

    driven: tuple[str, ...]
    missing: tuple[str, ...]
    unused: tuple[str, ...]


def weight_keys(rig: BlendshapeRig, take: Take) -> tuple[WeightKeys, ShapeMatch]:
    """A take's weights on a rig's shapes, a key a frame at its time; names are matched by ``shape_names.mapping``.

    Raises:
        NameMismatchError: no channel drives any shape.
        ValueRangeError: the take has no weights or no frame, or a weight is NaN.
    """
    track = take.weights
    if track is None or len(track) == 0 or track.values.shape[2] != 1:
        content = "no weights" if track is None else f"weights {tuple(track.values.shape)}"
        raise ValueRangeError(f"take: found {content}, expected weights (T,N,1) of at least one frame")
    values = track.values[..., 0].detach().cpu().float()
    if not torch.isfinite(values).all():
        frames = (~torch.isfinite(values)).any(1).nonzero()[:, 0]
        raise ValueRangeError(
            f"take: found NaN in the weights of {len(frames)} frames, first {int(frames[0])}; expected numbers"
        )
    matrix = mapping(track.names, rig.names)
    drives = matrix != 0
    if not drives.any():
        raise NameMismatchError(
            f"take: none of its {len(track.names)} channels ({', '.join(track.names[:5])}, ...) drives one of the "
            f"rig's {len(rig.names)} shapes ({', '.join(rig.names[:5])}, ...)"
        )
    by_shape, by_channel = drives.any(1).tolist(), drives.any(0).tolist()
    return WeightKeys(take.times, values @ matrix.T.to(values), take.fps), ShapeMatch(
        tuple(name for name, is_driven in zip(rig.names, by_shape, strict=True) if is_driven),
        tuple(name for name, is_driven in zip(rig.names, by_shape, strict=True) if not is_driven),
        tuple(name for name, is_used in zip(track.names, by_channel, strict=True) if not is_used),
    )
