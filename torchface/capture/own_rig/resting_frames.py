"""Frames of a take in which the face rests: by an expression that was read, or by the weights that were solved."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.capture.own_rig.eye_geometry import arkit_names

_LEAST_SHARE, _LEAST_FRAMES = 0.08, 8  # of the frames, that count as resting at least
_SAME = 0.3  # sums of weights that differ by less are as much at rest
_STEEP = 4
_EYES = ("eyeBlink", "eyeLook")  # who blinks or looks aside rests all the same
_SEEN = 0.3  # deviation of a reading beyond which it says nothing


def resting_share(activity: Tensor) -> Tensor:
    """How far a face rests in frames (T,) of some sum of weights, in [0,1]: about 1 in a twelfth of them; NaN is no
    rest."""
    known = torch.isfinite(activity)
    if not bool(known.any()):
        return torch.zeros_like(activity)
    values = activity[known].sort().values
    least = min(max(round(_LEAST_SHARE * len(values)), _LEAST_FRAMES), len(values)) - 1
    low = values[0]
    wide = max(float(values[least] - low), _SAME)
    return torch.where(known, 1 / (1 + ((activity - low) / (1.2 * wide)) ** _STEEP), 0.0)


def activity_of_weights(weights: Tensor, names: Sequence[str]) -> Tensor:
    """The sum of weights (T,N) but those of blinks and looks, (T,)."""
    counts = torch.tensor([not name.startswith(_EYES) for name in arkit_names(names)])
    return weights[:, counts.to(weights.device)].clamp(0, 1).sum(1)


def activity_of_readings(expression: Tensor, deviation: Tensor, names: Sequence[str]) -> Tensor:
    """The same of readings of weights (T,N) with their deviations (T,N); NaN in frames that say nothing.

    What is read of a shape in the take's lowest frames is an error that is alike in all. Deviations grow with weights:
    a shape that is seen in some frames counts in all, or a laugh would count as rest.
    """
    known = torch.isfinite(expression) & (deviation.nanquantile(0.1, dim=0) < _SEEN)
    values = torch.where(known, expression, torch.nan)
    beside = (values - values.nanquantile(0.1, dim=0).nan_to_num(0.0)).nan_to_num(0.0)
    return torch.where(known.any(1), activity_of_weights(beside, names), torch.nan)
