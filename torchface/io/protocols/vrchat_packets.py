"""VRChat's OSC: avatar parameters by Unified Expressions (v2) and by ARKit's names, and its own eye tracking."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.io.protocols.live_link_packets import ArkitWeights, rotations_sent
from torchface.io.protocols.osc_messages import LARGEST_IN_ETHERNET, osc_bundles, osc_message
from torchface.io.protocols.osc_packets import names_for_osc
from torchface.io.protocols.unified_parameters import ACTIVE, COMBINED, FULL_GAZE, LARGER
from torchface.shape_names import ARKIT, UNIFIED

VRCHAT_PORT = 9000

VRCHAT_NAMINGS = ("unified", "arkit", "eyes", "own")
"""What is sent: ``v2/`` parameters, ARKit's 52, VRChat's eye tracking, or the weights as they are called."""

_PARAMETERS = "/avatar/parameters/"


class VrchatPackets:
    """Packets of avatar parameters, by ``VRCHAT_NAMINGS``, and eye tracking; an avatar takes those that it has.

    Source: docs.vrchat.com, OSC Eye Tracking and OSC Avatar Parameters.
    """

    def __init__(self, names: Sequence[str], namings: Sequence[str] = VRCHAT_NAMINGS[:3]) -> None:
        self._own = names_for_osc(names) if "own" in namings else ()
        self._namings = frozenset(namings)
        self._arkit = None if self._namings == {"own"} else ArkitWeights(names)
        sent = [name for twins in UNIFIED.twins.values() for name in twins]
        row = {name: i for i, name in enumerate(UNIFIED.names)}
        sums = torch.zeros(len(COMBINED), len(UNIFIED.names))
        self._constant = torch.zeros(len(COMBINED))
        for i, terms in enumerate(COMBINED.values()):
            for name, share in terms.items():
                if name == "1":
                    self._constant[i] = share
                else:
                    sums[i, row[name]] = share
        self._sums, self._rows = sums, [row[name] for name in sent]
        self._sent = sent

    def __call__(self, weights: Tensor, rotations: Tensor | None) -> list[bytes]:
        """The packets of a frame: weights (N,), rotations (9,) in radians, of which the eyes' count."""
        parameters, eyes = dict[str, float](), list[bytes]()
        turned = rotations_sent(rotations)
        if self._own:
            if weights.shape != (len(self._own),):
                raise ShapeError(f"stream: found weights {tuple(weights.shape)}, expected ({len(self._own)},)")
            parameters |= dict(zip(self._own, weights.detach().float().cpu().nan_to_num(0.0).tolist(), strict=True))
        if self._arkit is not None:
            arkit = self._arkit(weights).clamp(0, 1)
            if "arkit" in self._namings:
                parameters |= dict(zip(ARKIT, arkit.tolist(), strict=True))
            if "unified" in self._namings:
                parameters |= {f"v2/{name}": value for name, value in self._unified(arkit, turned).items()}
            if "eyes" in self._namings:
                eyes = _eye_tracking(arkit, turned)
        messages = [osc_message(_PARAMETERS + name, value) for name, value in parameters.items()]
        messages += [osc_message(_PARAMETERS + name, True) for name in ACTIVE]
        return osc_bundles([*messages, *eyes], LARGEST_IN_ETHERNET)

    def _unified(self, arkit: Tensor, rotations: Tensor) -> dict[str, float]:
        unified = UNIFIED.from_arkit(arkit)
        values = dict(zip(self._sent, unified[self._rows].tolist(), strict=True))
        values |= dict(zip(COMBINED, (self._sums @ unified + self._constant).tolist(), strict=True))
        values |= {name: max(values[left], values[right]) for name, (left, right) in LARGER.items()}
        _, _, _, left_yaw, left_pitch, _, right_yaw, right_pitch, _ = (rotations / FULL_GAZE).clamp(-1, 1).tolist()
        gaze = {"EyeLeftX": left_yaw, "EyeLeftY": -left_pitch, "EyeRightX": right_yaw, "EyeRightY": -right_pitch}
        return values | gaze | {"EyeX": (left_yaw + right_yaw) / 2, "EyeY": -(left_pitch + right_pitch) / 2}


def _eye_tracking(arkit: Tensor, rotations: Tensor) -> list[bytes]:
    """VRChat's own: lids, and degrees down and to the right of the left and the right eye."""
    shut = float(arkit[[ARKIT.index("eyeBlinkLeft"), ARKIT.index("eyeBlinkRight")]].mean())
    _, _, _, left_yaw, left_pitch, _, right_yaw, right_pitch, _ = (rotations * (180 / math.pi)).tolist()
    return [
        osc_message("/tracking/eye/EyesClosedAmount", shut),
        osc_message("/tracking/eye/LeftRightPitchYaw", left_pitch, left_yaw, right_pitch, right_yaw),
    ]
