"""Faces as plain OSC: one address a weight, sent under any names and received under those of several programs."""

import math
import re
from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError
from torchface.io.protocols.live_link_packets import rotations_sent
from torchface.io.protocols.osc_messages import Message, osc_bundles, osc_message, read_osc
from torchface.io.protocols.received_face import ReceivedFace
from torchface.io.protocols.unified_parameters import ACTIVE, UnifiedFace
from torchface.io.weights.arkit_values import arkit_row, rotations_of_degrees
from torchface.io.weights.face_cap_text import FACE_CAP_ORDER
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT

_DEFAULT_PREFIX = "/torchface"
_NOT_IN_ADDRESSES = re.compile(r"[^!-~]|[#*,/?\[\]{}]")  # what OSC gives another meaning in an address

# VRChat's own: how far both lids are shut; degrees down and to the right of the left and the right eye.
_SHUT, _GAZE = "/tracking/eye/EyesClosedAmount", "/tracking/eye/LeftRightPitchYaw"
_EYES = [ROTATIONS.index(name) for name in ("LeftEyePitch", "LeftEyeYaw", "RightEyePitch", "RightEyeYaw")]
_MOST_UNUSED, _LONGEST = 1000, 100  # addresses that are remembered, and characters of each


class OscPackets:
    """Packets of plain OSC, one bundle a frame: ``PREFIX/weights/NAME`` and, in radians,
    ``PREFIX/rotations/HeadYaw`` and so on by Live Link Face's nine names, one float each.
    """

    def __init__(self, names: Sequence[str], prefix: str = "") -> None:
        prefix = prefix or _DEFAULT_PREFIX
        self._count = len(names)
        self._addresses = [f"{prefix}/weights/{name}" for name in names_for_osc(names)]
        self._addresses += [f"{prefix}/rotations/{name}" for name in ROTATIONS]

    def __call__(self, weights: Tensor, rotations: Tensor | None) -> list[bytes]:
        """The packets of a frame: weights (N,), rotations (9,) in radians; NaN is sent as 0."""
        if weights.shape != (self._count,):
            raise ShapeError(f"stream: found weights {tuple(weights.shape)}, expected ({self._count},)")
        values = torch.cat([weights.detach().float().cpu().nan_to_num(0.0), rotations_sent(rotations)]).tolist()
        return osc_bundles([osc_message(address, v) for address, v in zip(self._addresses, values, strict=True)])


def names_for_osc(names: Sequence[str]) -> Sequence[str]:
    """The names, which addresses must be able to hold."""
    strange = [name for name in names if not name or _NOT_IN_ADDRESSES.search(name)]
    if strange:
        raise NameMismatchError(
            f"stream: found the shape {strange[0]!r:.60}, expected names without blanks and without any of "
            "# * , / ? [ ] { }, which OSC addresses cannot hold"
        )
    return names


class OscReader:
    """A face of addresses that end in a shape's name; each packet with one is a frame, values stay until they change.

    Known are ARKit's names (``/torchface/weights/jawOpen``), Unified Expressions and their sums
    (``/avatar/parameters/v2/JawOpen``), VRChat's eye tracking, rotations by Live Link Face's names in radians, and what
    the app Face Cap sends (``/W``, ``/HR``, ``/ELR``, ``/ERR``). The others that are there are put into ``unused``.
    """

    def __init__(self, prefix: str = "", unused: dict[str, None] | None = None) -> None:
        self._prefix = prefix
        self._unused = {} if unused is None else unused
        self._weights = torch.full((len(ARKIT),), torch.nan)  # NaN until it comes
        self._unified = UnifiedFace()
        self._degrees = {"/HR": [0.0] * 3, "/ELR": [0.0] * 3, "/ERR": [0.0] * 3}

    def __call__(self, packet: bytes) -> list[ReceivedFace]:
        """The face after a packet; none if it has nothing of a face."""
        known = [self._take(message) for message in read_osc(packet) if message[0].startswith(self._prefix)]
        if not any(known):
            return []
        weights = torch.where(self._weights.isnan(), self._unified.arkit(), self._weights)
        return [ReceivedFace(weights, self._unified.rotations.clone(), "OSC")]

    def _take(self, message: Message) -> bool:
        address, values = message
        numbers = [float(value) for value in values if isinstance(value, int | float) and math.isfinite(value)]
        known = len(numbers) == len(values) > 0 and self._moves(address, numbers)
        if not known and len(self._unused) < _MOST_UNUSED and not address.endswith(ACTIVE):
            self._unused[address[:_LONGEST]] = None
        return known

    def _moves(self, address: str, numbers: list[float]) -> bool:
        *folders, name = address.split("/")
        if address == "/W" and len(numbers) == 2 and 0 <= numbers[0] < len(ARKIT):
            self._weights[ARKIT.index(FACE_CAP_ORDER[int(numbers[0])])] = numbers[1]
        elif address in self._degrees and len(numbers) in (2, 3):
            self._degrees[address] = [*numbers, 0.0][:3]
            self._unified.rotations = rotations_of_degrees(*self._degrees.values())
        elif address == _GAZE and len(numbers) == 4:
            self._unified.rotations[_EYES] = torch.tensor(numbers).deg2rad()
        elif name in ROTATIONS:
            self._unified.rotations[ROTATIONS.index(name)] = numbers[0]
        elif folders[-1:] == ["v2"] or address == _SHUT:
            return self._unified.take(name, numbers[0])
        elif (row := arkit_row(name)) is not None:
            self._weights[row] = numbers[0]
        else:
            return False
        return True
