r"""Two conventions for ``mouthClose``: a jaw that others open, or one that it opens itself.

ARKit's ``mouthClose`` closes the lips over a jaw that ``jawOpen`` has opened: the two are on together, and alone it
drives the lower lip into the upper one. In rigs for Audio2Face it is the whole pose, an open jaw with closed lips, so
that ``jawOpen`` is left out of it. With A for ARKit's and B for the other convention

.. math::
    D^B_{close} = D^A_{close} + D_{jaw}, \qquad w^A_{jaw} = w^B_{jaw} + w^B_{close}, \qquad w^A_{close} = w^B_{close}.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

from torchface.errors import NameMismatchError, ValueRangeError
from torchface.rig import BlendshapeRig
from torchface.shape_names import arkit_sources
from torchface.take import Track

__all__ = [
    "MouthClose",
    "jaw_into_mouth_close",
    "jaw_out_of_mouth_close",
    "mouth_close_of",
]

JAW, CLOSE = "jawOpen", "mouthClose"

_FAR = 0.5  # vertices that the jaw moves at least this share of the farthest decide
_CHIN = 0.9
"""Of them the chin and the teeth follow the jaw, which no closing of lips does; they are the upper tenth at least."""
_UNCLEAR = (0.3, 0.7)
_CLIPPED = 0.01


@dataclass(frozen=True)
class MouthClose:
    """How a rig's ``mouthClose`` is meant.

    Args:
        opens_jaw: it opens the jaw itself; otherwise ``jawOpen`` does, as in ARKit.
        share: how far it moves the chin, of what ``jawOpen`` does: about 0 or about 1.
    """

    opens_jaw: bool
    share: float


def mouth_close_of(rig: BlendshapeRig) -> MouthClose | None:
    """Which convention a rig follows; None where it has no such two shapes.

    Raises:
        ValueRangeError: its ``mouthClose`` moves the chin part of the way, or ``jawOpen`` moves nothing.

    Example:
        >>> from torchface.synthetic import performer
        >>> mouth_close_of(performer(texture=False)).opens_jaw  # ARKit's convention
        False
    """
    rows = _rows(rig.names)
    if rows is None:
        return None
    jaw, close = rig.deltas[list(rows)].detach().double()
    square = jaw.square().sum(-1)
    if not float(square.max()) > 0:
        raise ValueRangeError(f"rig: its {rig.names[rows[0]]} moves nothing, expected a jaw that opens")
    far = square >= _FAR**2 * square.max()
    share = float(((close * jaw).sum(-1) / square)[far].quantile(_CHIN))
    if _UNCLEAR[0] < share < _UNCLEAR[1]:
        raise ValueRangeError(
            f"rig: its {rig.names[rows[1]]} moves the chin {share:.0%} of the way that {rig.names[rows[0]]} does; "
            "expected nearly none (ARKit's) or nearly all of it (Audio2Face's)"
        )
    return MouthClose(share >= _UNCLEAR[1], share)


def jaw_into_mouth_close(track: Track) -> Track:
    """ARKit's weights for a rig whose ``mouthClose`` opens the jaw: its weight is taken from ``jawOpen``'s.

    A jaw that is less open than lips are closed has no counterpart: its weight stays at 0, with a warning.

    Raises:
        NameMismatchError: the track lacks one of the shapes.

    Example:
        >>> import torch
        >>> arkit = Track(("jawOpen", "mouthClose"), torch.tensor([[[0.75], [0.25]]]))
        >>> jaw_into_mouth_close(arkit).values[0, :, 0].tolist()
        [0.5, 0.25]
    """
    return _moved(track, -1.0)


def jaw_out_of_mouth_close(track: Track) -> Track:
    """The weights of a rig whose ``mouthClose`` opens the jaw, for ARKit's; see :func:`jaw_into_mouth_close`.

    Example:
        >>> import torch
        >>> other = Track(("jawOpen", "mouthClose"), torch.tensor([[[0.5], [0.25]]]))
        >>> jaw_out_of_mouth_close(other).values[0, :, 0].tolist()
        [0.75, 0.25]
    """
    return _moved(track, 1.0)


def _moved(track: Track, sign: float) -> Track:
    rows = _rows(track.names)
    if rows is None:
        raise NameMismatchError(f"weights: found no {JAW} and {CLOSE}, expected both")
    jaw, close = rows
    values = track.values.clone()
    wanted = values[:, jaw] + sign * values[:, close]
    values[:, jaw] = wanted.clamp(0, 1)
    beyond = (values[:, jaw] - wanted).abs().nan_to_num(0.0)
    if float(beyond.max() if beyond.numel() else 0.0) > _CLIPPED:
        frames = int((beyond > _CLIPPED).any(-1).sum())
        warnings.warn(
            f"weights: {JAW} would be as far as {float(beyond.max()):.2g} outside 0 to 1 in {frames} of {len(track)} "
            "frames, and is kept inside: lips close there over a jaw that is not open",
            stacklevel=3,
        )
    return replace(track, values=values)


def _rows(names: Sequence[str]) -> tuple[int, int] | None:
    """Of ``jawOpen`` and ``mouthClose``, however they are spelled."""
    sources = arkit_sources(names)
    if JAW not in sources or CLOSE not in sources:
        return None
    return sources[JAW][0], sources[CLOSE][0]
