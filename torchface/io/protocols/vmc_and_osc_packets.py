"""Frames of weights as OSC messages: by the VMC protocol, which avatar programs receive, and plain."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Sequence

import torch
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message import OscMessage
from pythonosc.osc_message_builder import OscMessageBuilder
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError
from torchface.io.protocols.live_link_packets import ArkitWeights, rotations_sent
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT

VMC_PORT = 39539
_DEFAULT_PREFIX = "/torchface"

_LARGEST_VMC = 1400  # bytes of a packet, which one Ethernet frame must hold
_LARGEST = 60_000  # what UDP carries
_NOT_IN_ADDRESSES = re.compile(r"[^!-~]|[#*,/?\[\]{}]")  # what OSC gives another meaning in an address


class VmcPackets:
    """Packets of the VMC protocol: ``/VMC/Ext/Blend/Val`` a shape by ARKit's names, ``/VMC/Ext/Blend/Apply``, the
    head's rotation as ``/VMC/Ext/Bone/Pos``, ``/VMC/Ext/OK`` and ``/VMC/Ext/T``.

    Args:
        names: of the weights that come, (N,); any rig's names that ARKit's can be had from.
        clock: what time it is, seconds.

    Source: Virtual Motion Capture Protocol, marionette specification, protocol.vmc.info.
    """

    def __init__(self, names: Sequence[str], clock: Callable[[], float] = time.perf_counter) -> None:
        self._arkit, self._clock, self._began = ArkitWeights(names), clock, clock()

    def __call__(self, weights: Tensor, rotations: Tensor | None) -> list[bytes]:
        """The packets of a frame: weights (N,), rotations (9,) in radians, of which the head's count.

        Raises:
            ShapeError: another number of weights than names, or of rotations than nine.
        """
        messages = [
            _message("/VMC/Ext/OK", 1),
            _message("/VMC/Ext/T", self._clock() - self._began),
            # The skeleton keeps its own places of bones: a receiver adds the rotation to the rest pose.
            _message("/VMC/Ext/Bone/Pos", "Head", 0.0, 0.0, 0.0, *unity_quaternion(rotations_sent(rotations)[:3])),
        ]
        values = self._arkit(weights).tolist()
        messages += [_message("/VMC/Ext/Blend/Val", name, value) for name, value in zip(ARKIT, values, strict=True)]
        messages.append(_message("/VMC/Ext/Blend/Apply"))
        return _bundles(messages, _LARGEST_VMC)


class OscPackets:
    """Packets of plain OSC, one bundle a frame: ``PREFIX/weights/NAME`` and, in radians,
    ``PREFIX/rotations/HeadYaw`` and so on by Live Link Face's nine names, one float each.

    Args:
        names: of the weights that come, (N,).
        prefix: of the addresses; ``/torchface`` if empty.
    """

    def __init__(self, names: Sequence[str], prefix: str = "") -> None:
        strange = [name for name in names if not name or _NOT_IN_ADDRESSES.search(name)]
        if strange:
            raise NameMismatchError(
                f"stream: found the shape {strange[0]!r:.60}, expected names without blanks and without any of "
                "# * , / ? [ ] { }, which OSC addresses cannot hold"
            )
        prefix = prefix or _DEFAULT_PREFIX
        self._count = len(names)
        self._addresses = [f"{prefix}/weights/{name}" for name in names]
        self._addresses += [f"{prefix}/rotations/{name}" for name in ROTATIONS]

    def __call__(self, weights: Tensor, rotations: Tensor | None) -> list[bytes]:
        """The packets of a frame: weights (N,), rotations (9,) in radians; NaN is sent as 0.

        Raises:
            ShapeError: another number of weights than names, or of rotations than nine.
        """
        if weights.shape != (self._count,):
            raise ShapeError(f"stream: found weights {tuple(weights.shape)}, expected ({self._count},)")
        values = torch.cat([weights.detach().float().cpu().nan_to_num(0.0), rotations_sent(rotations)]).tolist()
        return _bundles([_message(address, value) for address, value in zip(self._addresses, values, strict=True)])


def unity_quaternion(angles: Tensor) -> tuple[float, float, float, float]:
    r"""A head's yaw, pitch and roll (3,), radians, as Unity's quaternion x, y, z, w; NaN counts as 0.

    Ours is :math:`R_y R_x R_z` with x to the person's left; Unity's x is to their right, which turns the signs of y
    and z.
    """
    half = angles.detach().double().cpu().nan_to_num(0.0) / 2
    (sy, sx, sz), (cy, cx, cz) = half.sin().tolist(), half.cos().tolist()
    x, y = cy * sx * cz + sy * cx * sz, sy * cx * cz - cy * sx * sz
    z, w = cy * cx * sz - sy * sx * cz, cy * cx * cz + sy * sx * sz
    return x, -y, -z, w


def _message(address: str, *values: str | int | float) -> OscMessage:
    kinds = {str: "s", int: "i", float: "f"}
    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value, kinds[type(value)])
    return builder.build()


def _bundles(messages: Iterable[OscMessage], largest: int = _LARGEST) -> list[bytes]:
    """The messages in bundles of at most so many bytes, in their order."""
    packets, bundle, size = list[bytes](), OscBundleBuilder(IMMEDIATELY), 16
    for message in messages:
        if size + message.size + 4 > largest:
            packets.append(bundle.build().dgram)
            bundle, size = OscBundleBuilder(IMMEDIATELY), 16
        bundle.add_content(message)
        size += message.size + 4
    return [*packets, bundle.build().dgram]
