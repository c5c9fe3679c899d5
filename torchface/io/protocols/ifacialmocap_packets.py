"""iFacialMocap's packets: a frame as text, sent by the app to whoever asks for it."""

from collections.abc import Sequence

from torch import Tensor

from torchface.errors import FileFormatError
from torchface.io.protocols.live_link_packets import ArkitWeights, rotations_sent
from torchface.io.protocols.received_face import ReceivedFace
from torchface.io.weights.arkit_values import degrees_of_rotations
from torchface.io.weights.ifacialmocap_text import read_frame
from torchface.shape_names import ARKIT

IFACIALMOCAP_PORT = 49983

START = b"iFacialMocap_sahuasouryya9218sauhuiayeta91555dy3719"
"""What the app waits for before it sends to whoever sent this."""

_HANDSHAKES = (b"iFacialMocap_", b"FACEMOTION3D_", b"StopStreaming_")
_SIDES = {"Left": "_L", "Right": "_R"}


def _app_name(name: str) -> str:
    """The app's spelling: ``eyeBlink_L``; ``jawLeft`` and ``mouthLeft`` are no sides and stay."""
    for side, end in _SIDES.items():
        if name.endswith(side) and name.removesuffix(side) not in ("jaw", "mouth"):
            return name.removesuffix(side) + end
    return name


_NAMES = tuple(_app_name(name) for name in ARKIT)


class IFacialMocapPackets:
    """Packets of frames as the app would send them: weights in percent, rotations in degrees.

    Source: iFacialMocap, communication specifications, ifacialmocap.com/for-developer.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._arkit = ArkitWeights(names)

    def __call__(self, weights: Tensor, rotations: Tensor | None) -> list[bytes]:
        """The packet of a frame: weights (N,), rotations (9,) in radians; NaN is sent as 0."""
        percent = (100 * self._arkit(weights).clamp(0, 1)).round().int().tolist()
        head, left, right = degrees_of_rotations(rotations_sent(rotations))
        fields = [f"{name}-{value}" for name, value in zip(_NAMES, percent, strict=True)]
        fields += [f"=head#{_numbers([*head, 0.0, 0.0, 0.0])}"]
        fields += [f"rightEye#{_numbers(right)}", f"leftEye#{_numbers(left)}"]
        return ["|".join([*fields, ""]).encode()]


def read_ifacialmocap(packet: bytes) -> list[ReceivedFace]:
    """The face of a packet; a handshake of another receiver has none."""
    if packet.startswith(_HANDSHAKES):
        return []
    try:
        text = packet.decode()
    except UnicodeDecodeError as error:
        raise FileFormatError(f"packet: found no UTF-8 ({error.reason}), expected iFacialMocap's text") from error
    weights, rotations = read_frame(text)
    return [ReceivedFace(weights, rotations, "iFacialMocap")]


def _numbers(values: Sequence[float]) -> str:
    return ",".join(str(round(value, 5) + 0.0) for value in values)
