"""Packets to one place over UDP: addresses, the host looked up, and a receiver that is not there."""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass
from typing import Any

from torchface.errors import ValueRangeError

DEFAULT_PORTS = {"livelink": 11111, "vmc": 39539}
"""Where receivers listen unless they are told otherwise; the other schemes' addresses name their port."""

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

    Raises:
        ValueRangeError: the text is no such address.
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


class UdpSocket:
    """Sends packets to one address; that nobody listens there yet is counted and no error.

    Args:
        address: as :func:`parse_address` takes it. A broadcast address reaches a whole network.

    Raises:
        ValueRangeError: the address is none, its host is not known, or this machine's network does not reach it.
    """

    def __init__(self, address: str) -> None:
        family, target = find_receiver(address)
        self.address = address
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        try:
            self._socket.connect(target)  # of one that is not connected the system tells no refusal
        except OSError as error:
            self._socket.close()
            raise self._unreachable(error) from error

    def send(self, packet: bytes) -> bool:
        """Sends a packet; whether nothing said that a packet before it was refused.

        Raises:
            ValueRangeError: this machine cannot send there.
        """
        welcome = True
        for _ in range(2):  # the first call tells of the packet before and sends nothing
            try:
                self._socket.send(packet)
                return welcome
            except ConnectionError:
                welcome = False
            except OSError as error:
                raise self._unreachable(error) from error
        return welcome

    def close(self) -> None:
        """Gives the socket back."""
        self._socket.close()

    def _unreachable(self, error: OSError) -> ValueRangeError:
        return ValueRangeError(
            f"stream: cannot send to {self.address} ({error.strerror or error}); expected an address that this "
            "machine's network reaches"
        )
