"""Senders of frames of weights over UDP, by the scheme of an address."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.io.protocols.live_link_packets import LIVE_LINK_PORT, LiveLinkPackets
from torchface.io.protocols.vmc_and_osc_packets import VMC_PORT, OscPackets, VmcPackets

Encode = Callable[[Tensor, Tensor | None], list[bytes]]
"""Packets of a frame: weights (N,), and rotations (9,) in radians, none of which turn the head."""

DEFAULT_PORTS = {"livelink": LIVE_LINK_PORT, "vmc": VMC_PORT}
"""Where receivers listen unless they are set up otherwise; the other schemes' addresses name their port."""

_SCHEMES = ("udp", "livelink", "vmc", "osc")
_ADDRESS = re.compile(
    r"(?P<scheme>[a-z]+)://(?P<host>\[[0-9a-fA-F:.]+\]|[^:/\[\]\s]+)(?::(?P<port>[0-9]{1,5}))?(?P<path>/[!-~]*)?"
)
_EXPECTED = (
    "expected an address such as udp://127.0.0.1:11111 or livelink://127.0.0.1:11111 (Live Link Face), "
    "vmc://127.0.0.1:39539 or osc://127.0.0.1:9000/torchface, the port 1 to 65535"
)


@dataclass(frozen=True)
class StreamAddress:
    """The parts of ``SCHEME://HOST:PORT/PATH``; the path has no slash at its end and may be empty."""

    scheme: str
    host: str
    port: int
    path: str = ""


def parse_address(address: str) -> StreamAddress:
    """The parts of an address.

    Example:
        >>> parse_address("udp://127.0.0.1:11111")
        StreamAddress(scheme='udp', host='127.0.0.1', port=11111, path='')
        >>> parse_address("vmc://localhost").port
        39539
    """
    match = _ADDRESS.fullmatch(address)
    if match is None or match["scheme"] not in _SCHEMES:
        raise ValueRangeError(f"stream: found {address!r:.200}, {_EXPECTED}")
    scheme, path = match["scheme"], (match["path"] or "").rstrip("/")
    port = int(match["port"]) if match["port"] else DEFAULT_PORTS.get(scheme, 0)
    if not 0 < port < 65536 or (path and scheme != "osc"):
        raise ValueRangeError(f"stream: found {address!r:.200}, {_EXPECTED}")
    return StreamAddress(scheme, match["host"].strip("[]"), port, path)


def find_receiver(address: str) -> tuple[socket.AddressFamily, Any]:
    """Family and socket address of an address, its host looked up.

    Raises:
        ValueRangeError: the text is no such address, or its host is not known.
    """
    parts = parse_address(address)
    try:
        family, _, _, _, target = socket.getaddrinfo(parts.host, parts.port, type=socket.SOCK_DGRAM)[0]
    except (OSError, ValueError) as error:  # ValueError: a name that no host can have, such as a..b
        raise ValueRangeError(f"stream: found {address!r:.200}, whose host is not known ({error})") from error
    return family, target


class WeightSender:
    """Sends one frame after another to one address; that nobody listens there yet is reported and no error.

    Args:
        address: see :func:`open_sender`. A broadcast address reaches a whole network.
        encode: makes the packets of a frame.

    Raises:
        ValueRangeError: the address is none, its host is not known, or this machine's network does not reach it.
    """

    def __init__(self, address: str, encode: Encode) -> None:
        family, target = find_receiver(address)
        self.address, self._encode = address, encode
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        try:
            self._socket.connect(target)  # of one that is not connected the system reports no refusal
        except OSError as error:
            self._socket.close()
            raise self._unreachable(error) from error

    def send(self, weights: Tensor, rotations: Tensor | None = None) -> bool:
        """Sends one frame: weights (N,), Live Link Face's rotations (9,) in radians; NaN is sent as 0.

        Returns:
            Whether no packet before was reported as refused.

        Raises:
            ShapeError: another number of weights than names.
            ValueRangeError: this machine cannot send there.
        """
        welcome = [self._send(packet) for packet in self._encode(weights, rotations)]
        return all(welcome)

    def close(self) -> None:
        """Gives the socket back."""
        self._socket.close()

    def _send(self, packet: bytes) -> bool:
        welcome = True
        for _ in range(2):  # the first call reports the packet before and sends nothing
            try:
                self._socket.send(packet)
                return welcome
            except ConnectionError:
                welcome = False
            except OSError as error:
                raise self._unreachable(error) from error
        return welcome

    def _unreachable(self, error: OSError) -> ValueRangeError:
        return ValueRangeError(
            f"stream: cannot send to {self.address} ({error.strerror or error}); expected an address that this "
            "machine's network reaches"
        )


def open_sender(address: str, names: Sequence[str], fps: float) -> WeightSender:
    """A sender to an address.

    Args:
        address: ``udp://HOST:PORT`` or ``livelink://HOST:PORT`` for Live Link Face's packets, ``vmc://HOST:PORT`` for
            the VMC protocol, ``osc://HOST:PORT/PREFIX`` for plain OSC.
        names: of the weights that come, (N,).
        fps: frames a second.

    Raises:
        ValueRangeError: the address is none, or its host is not known or not reached; or ``fps`` is no camera's.
        NameMismatchError: the protocol cannot carry weights by these names.

    Example:
        >>> sender = open_sender("vmc://127.0.0.1:39539", ["jawOpen", "browInnerUp"], fps=60.0)
        >>> nobody_refused = sender.send(torch.tensor([0.5, 0.0]))
        >>> sender.close()
    """
    parts = parse_address(address)
    if parts.scheme == "vmc":
        return WeightSender(address, VmcPackets(names))
    if parts.scheme == "osc":
        return WeightSender(address, OscPackets(names, parts.path))
    return WeightSender(address, LiveLinkPackets(names, fps))
