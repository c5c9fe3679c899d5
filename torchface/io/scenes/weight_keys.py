"""A take's weights as the keys of a rig's animation."""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ValueRangeError
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping
from torchface.take import Take
from torchface.temporal.key_reduction import KeyReduction, kept_keys, reduction_error


@dataclass(frozen=True)
class WeightKeys:
    """Keys of an animation, linear between them."""

    seconds: Tensor  # of each key, (T,) float64, rising from 0
    weights: Tensor  # of a rig's shapes, (T,N) float32
    fps: float  # frames a second of the film that they are for
    # Which of the keys each shape's curve has, (T,N) bool, in a file whose curves have keys of their own; all if
    # absent.
    kept: Tensor | None = None


@dataclass(frozen=True)
class ShapeMatch:
    """Which of a rig's shapes a take's channels drive.

    Args:
        driven: shapes of the rig that follow a channel.
        missing: shapes of the rig that no channel drives; they stay at 0.
        unused: channels of the take that the rig has no shape for.
        reduction: how many keys were left, where few were asked for.

    Example:
        >>> match = ShapeMatch(driven=("jawOpen",), missing=("mouthClose",), unused=("tongueOut",))
        >>> f"{match.missing[0]} stays at 0, {match.unused[0]} moves nothing"
        'mouthClose stays at 0, tongueOut moves nothing'
    """

    driven: tuple[str, ...]
    missing: tuple[str, ...]
    unused: tuple[str, ...]
    reduction: KeyReduction | None = field(default=None, repr=False)


def weight_keys(rig: BlendshapeRig, take: Take) -> tuple[WeightKeys, ShapeMatch]:
    """A take's weights on a rig's shapes, a key a frame at its time; names are matched by ``shape_names.mapping``."""
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


def with_correctives(rig: BlendshapeRig, keys: WeightKeys) -> WeightKeys:
    """Keys of shapes and correctives, which get the weights that the shapes' call for, so that they play everywhere."""
    if rig.activation is None:
        return keys
    followed = rig.activation(keys.weights.to(rig.vertices.device)).cpu()
    return replace(keys, weights=torch.cat([keys.weights, followed], 1))


def common_keys(rig: BlendshapeRig, keys: WeightKeys, bound: float) -> tuple[WeightKeys, KeyReduction]:
    """Few keys that all shapes share, for files that have one time for all; frames' weights stay within ``bound`` of
    the lines between them, and those of correctives, which such files hold as weights, too."""
    values = with_correctives(rig, keys).weights
    kept = kept_keys(keys.seconds, values, bound)
    reduction = KeyReduction(len(kept), int(kept.sum()), reduction_error(keys.seconds, values, kept))
    return replace(keys, seconds=keys.seconds[kept], weights=keys.weights[kept]), reduction


def keys_of_curves(keys: WeightKeys, bound: float) -> tuple[WeightKeys, KeyReduction]:
    """Few keys for each shape that moves, for files whose curves have keys of their own; see :func:`common_keys`."""
    moving = keys.weights.any(0).nonzero()[:, 0].tolist()
    kept, largest = torch.ones_like(keys.weights, dtype=torch.bool), 0.0
    for column in moving:  # each curve has keys of its own
        values = keys.weights[:, column : column + 1]
        kept[:, column] = kept_keys(keys.seconds, values, bound)
        largest = max(largest, reduction_error(keys.seconds, values, kept[:, column]))
    before, after = len(moving) * len(keys.weights), int(kept[:, moving].sum())
    return replace(keys, kept=kept), KeyReduction(before, after, largest)
