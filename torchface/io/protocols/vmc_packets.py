"""The VMC protocol, by which avatar programs send and receive faces: clips and bones as OSC messages."""

import math
import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError
from torchface.io.protocols.live_link_packets import ArkitWeights, rotations_sent
from torchface.io.protocols.osc_messages import LARGEST_IN_ETHERNET, osc_bundles, osc_message, read_osc
from torchface.io.protocols.received_face import ReceivedFace
from torchface.io.weights.arkit_values import arkit_row
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT, VRM0, VRM1

VMC_PORT = 39539

NAMINGS = ("arkit", "vrm0", "vrm1", "own")
"""What clips may be called: ARKit's 52 names, VRM's of its two versions, or as the weights come."""

_NECK_SHARE = 0.3  # of the head's rotation
_MOST_CLIPS = 1000

Quaternion = tuple[float, float, float, float]


class VmcPackets:
    """Packets of the VMC protocol: ``/VMC/Ext/Blend/Val`` a clip, ``/VMC/Ext/Blend/Apply``, the rotations of head,
    neck and eyes as ``/VMC/Ext/Bone/Pos``, ``/VMC/Ext/Root/Pos``, ``/VMC/Ext/OK`` and ``/VMC/Ext/T``.

    Args:
        names: of the weights that come, (N,); any rig's names that ARKit's can be had from.
        namings: of ``NAMINGS``; an avatar leaves out the clips that it lacks.

    Source: Virtual Motion Capture Protocol, marionette specification, protocol.vmc.info.
    """

    def __init__(
        self, names: Sequence[str], namings: Sequence[str] = NAMINGS[:3], clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._own = tuple(names) if "own" in namings else ()
        self._arkit = None if set(namings) == {"own"} else ArkitWeights(names)
        self._whole = "arkit" in namings
        self._vrm = {"vrm0": VRM0.names, "vrm1": VRM1.names}
        self._vrm = {naming: clips for naming, clips in self._vrm.items() if naming in namings}
        self._clock, self._began = clock, clock()

    def __call__(self, weights: Tensor, rotations: Tensor | None) -> list[bytes]:
        """The packets of a frame: weights (N,), rotations (9,) in radians."""
        messages = [
            osc_message("/VMC/Ext/OK", 1),
            osc_message("/VMC/Ext/T", self._clock() - self._began),
            osc_message("/VMC/Ext/Root/Pos", "root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        ]
        # The skeleton keeps its own places of bones: a receiver adds the rotation to the rest pose.
        for bone, turn in bone_rotations(rotations_sent(rotations)).items():
            messages.append(osc_message("/VMC/Ext/Bone/Pos", bone, 0.0, 0.0, 0.0, *turn))
        messages += [osc_message("/VMC/Ext/Blend/Val", name, value) for name, value in self._clips(weights).items()]
        messages.append(osc_message("/VMC/Ext/Blend/Apply"))
        return osc_bundles(messages, LARGEST_IN_ETHERNET)

    def _clips(self, weights: Tensor) -> dict[str, float]:
        clips = dict[str, float]()
        if self._own:
            if weights.shape != (len(self._own),):
                raise ShapeError(f"stream: found weights {tuple(weights.shape)}, expected ({len(self._own)},)")
            clips |= dict(zip(self._own, weights.detach().float().cpu().nan_to_num(0.0).tolist(), strict=True))
        if self._arkit is not None:
            arkit = self._arkit(weights)
            values = VRM0.from_arkit(arkit).tolist() if self._vrm else []
            for names in self._vrm.values():
                clips |= dict(zip(names, values, strict=True))
            clips |= dict(zip(ARKIT, arkit.tolist(), strict=True)) if self._whole else {}
        return clips


class VmcReader:
    """Gathers the messages of packets into faces; a face is whole when the sender says so (``Blend/Apply``).

    ARKit's names are taken as they are; of a sender that has only VRM's clips, the poses that they stand for.
    """

    def __init__(self) -> None:
        self._clips = dict[str, float]()
        self._bones = dict[str, Quaternion]()

    def __call__(self, packet: bytes) -> list[ReceivedFace]:
        """The faces that a packet completes."""
        faces = []
        for address, values in read_osc(packet):
            if address == "/VMC/Ext/Blend/Val":
                name, weight = _checked(values, 1)
                if name in self._clips or len(self._clips) < _MOST_CLIPS:
                    self._clips[name] = weight[0]
            elif address == "/VMC/Ext/Bone/Pos":
                name, motion = _checked(values, 7)
                if name in _BONES:
                    self._bones[name] = (motion[3], motion[4], motion[5], motion[6])
            elif address == "/VMC/Ext/Blend/Apply":
                faces.append(self._face())
        return faces

    def _face(self) -> ReceivedFace:
        weights = torch.zeros(len(ARKIT))
        rows = {row: value for name, value in self._clips.items() if (row := arkit_row(name)) is not None}
        if rows:
            weights[list(rows)] = torch.tensor(list(rows.values()))
        else:
            for table in (VRM0, VRM1):
                weights += table.to_arkit(torch.tensor([self._clips.get(name, 0.0) for name in table.names]))
        return ReceivedFace(weights, _rotations(self._bones), "VMC")


def _checked(values: Sequence[object], count: int) -> tuple[str, list[float]]:
    """A name and at least so many finite numbers."""
    numbers = [value for value in values[1:] if isinstance(value, int | float) and math.isfinite(value)]
    if not values or not isinstance(values[0], str) or len(numbers) < count or len(numbers) != len(values) - 1:
        raise FileFormatError(f"packet: found the values {values!r:.80}, expected a name and {count} numbers")
    return values[0], [float(number) for number in numbers]


_BONES = ("Head", "Neck", "LeftEye", "RightEye")


def bone_rotations(rotations: Tensor) -> dict[str, Quaternion]:
    """Unity's quaternions of the four bones of rotations (9,), radians; neck and head together turn as the head."""
    yaw, pitch, roll, left_yaw, left_pitch, left_roll, right_yaw, right_pitch, right_roll = rotations.tolist()
    turn = unity_quaternion(torch.tensor([yaw, pitch, roll], dtype=torch.float64))
    return {
        "Neck": _share(turn, _NECK_SHARE),
        "Head": _share(turn, 1 - _NECK_SHARE),
        # An eye's yaw is to the person's right, a head's to the left.
        "LeftEye": unity_quaternion(torch.tensor([-left_yaw, left_pitch, left_roll], dtype=torch.float64)),
        "RightEye": unity_quaternion(torch.tensor([-right_yaw, right_pitch, right_roll], dtype=torch.float64)),
    }


def unity_quaternion(angles: Tensor) -> Quaternion:
    r"""A head's yaw, pitch and roll (3,), radians, as Unity's quaternion x, y, z, w; NaN counts as 0.

    Ours is :math:`R_y R_x R_z` with x to the person's left; Unity's x is to their right, which turns the signs of y
    and z.
    """
    half = angles.detach().double().cpu().nan_to_num(0.0) / 2
    (sy, sx, sz), (cy, cx, cz) = half.sin().tolist(), half.cos().tolist()
    x, y = cy * sx * cz + sy * cx * sz, sy * cx * cz - cy * sx * sz
    z, w = cy * cx * sz - sy * sx * cz, cy * cx * cz + sy * sx * sz
    return x, -y, -z, w


def unity_angles(turn: Quaternion) -> tuple[float, float, float]:
    """Yaw, pitch and roll, radians, of Unity's quaternion; see :func:`unity_quaternion`."""
    size = math.sqrt(sum(part * part for part in turn))
    if size < 1e-6:
        return 0.0, 0.0, 0.0
    x, y, z, w = turn[0] / size, -turn[1] / size, -turn[2] / size, turn[3] / size
    yaw = math.atan2(2 * (x * z + w * y), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * x - y * z))))
    return yaw, pitch, math.atan2(2 * (x * y + w * z), 1 - 2 * (x * x + z * z))


def _share(turn: Quaternion, share: float) -> Quaternion:
    """A share of a rotation about its axis."""
    *axis, w = turn if turn[3] >= 0 else tuple(-part for part in turn)
    sine = math.sqrt(sum(part * part for part in axis))
    if sine < 1e-9:
        return 0.0, 0.0, 0.0, 1.0
    angle = share * math.atan2(sine, w)
    scale = math.sin(angle) / sine
    return axis[0] * scale, axis[1] * scale, axis[2] * scale, math.cos(angle)


def _after(first: Quaternion, second: Quaternion) -> Quaternion:
    (a, b, c, d), (e, f, g, h) = first, second
    return (
        d * e + a * h + b * g - c * f,
        d * f - a * g + b * h + c * e,
        d * g + a * f - b * e + c * h,
        d * h - a * e - b * f - c * g,
    )


def _rotations(bones: dict[str, Quaternion]) -> Tensor:
    still = (0.0, 0.0, 0.0, 1.0)
    head = unity_angles(_after(bones.get("Neck", still), bones.get("Head", still)))
    angles = list(head)
    for eye in ("LeftEye", "RightEye"):
        yaw, pitch, roll = unity_angles(bones.get(eye, still))
        angles += [-yaw, pitch, roll]
    assert len(angles) == len(ROTATIONS)
    return torch.tensor(angles)
