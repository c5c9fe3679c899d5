"""Senders of frames of weights over a network, by the scheme of an address."""

import socket
import time
from collections.abc import Callable, Sequence
from typing import Protocol

from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.io.protocols.ifacialmocap_packets import IFacialMocapPackets
from torchface.io.protocols.live_link_packets import LiveLinkPackets
from torchface.io.protocols.osc_packets import OscPackets
from torchface.io.protocols.stream_address import StreamAddress, parse_address, resolved
from torchface.io.protocols.vmc_packets import NAMINGS, VmcPackets
from torchface.io.protocols.vrchat_packets import VRCHAT_NAMINGS, VrchatPackets
from torchface.io.protocols.vtube_studio import VTubeStudioSender, checked_token_file

Encode = Callable[[Tensor, Tensor | None], list[bytes]]
"""Packets of a frame: weights (N,), and rotations (9,) in radians, none of which turn the head."""

_EARLY = 0.25  # of an interval, by which frames may come before their time


class FrameSender(Protocol):
    """Sends frames to one receiver; ``problem`` says in words why they do not arrive, where that is known."""

    address: str
    problem: str

    def send(self, weights: Tensor, rotations: Tensor | None = None) -> bool:
        """Sends a frame without waiting: weights (N,), rotations (9,); whether none before was refused."""

    def close(self) -> None:
        """Gives back what it holds."""


class WeightSender:
    """Sends one frame after another to one address by UDP; that nobody listens there yet is reported and no error.

    Args:
        address: see :func:`open_sender`. A broadcast address reaches a whole network.
        encode: makes the packets of a frame.
        rate: frames a second at most; those between are left out. All if absent.

    Raises:
        ValueRangeError: the address is none, its host is not known, or this machine's network does not reach it.

    Example:
        >>> sender = WeightSender("udp://127.0.0.1:11111", lambda weights, rotations: [bytes(3)])
        >>> sender.send(torch.zeros(1))
        True
        >>> sender.close()
    """

    def __init__(self, address: str, encode: Encode, rate: float | None = None) -> None:
        family, target = resolved(parse_address(address), address)
        self.address, self.problem, self._encode = address, "nobody listens there yet", encode
        self._interval, self._due, self._welcome = 0.0 if rate is None else 1 / rate, float("-inf"), True
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._socket.setblocking(False)
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
        now = time.monotonic()
        if now < self._due - _EARLY * self._interval:
            return self._welcome
        self._due = max(self._due, now - self._interval) + self._interval
        welcome = [self._send(packet) for packet in self._encode(weights, rotations)]
        self._welcome = all(welcome)
        return self._welcome

    def close(self) -> None:
        """Gives the socket back."""
        self._socket.close()

    def _send(self, packet: bytes) -> bool:
        welcome = True
        for _ in range(2):  # the first call reports the packet before and sends nothing
            try:
                self._socket.send(packet)
                return welcome
            except (ConnectionError, BlockingIOError):  # a full queue: a later frame is better than a late one
                welcome = False
            except OSError as error:
                raise self._unreachable(error) from error
        return welcome

    def _unreachable(self, error: OSError) -> ValueRangeError:
        return ValueRangeError(
            f"stream: cannot send to {self.address} ({error.strerror or error}); expected an address that this "
            "machine's network reaches"
        )


def find_receiver(address: str) -> None:
    """Looks an address up before any work."""
    resolved(parse_address(address), address)


def open_sender(address: str, names: Sequence[str], fps: float) -> FrameSender:
    """A sender to an address.

    Args:
        address: ``udp://HOST:PORT`` or ``livelink://HOST:PORT`` for Live Link Face's packets, ``vmc://HOST:PORT`` for
            the VMC protocol, ``osc://HOST:PORT/PREFIX`` for plain OSC, ``ifacialmocap://HOST:PORT``,
            ``vrchat://HOST:PORT``, ``vts://HOST:PORT`` for VTube Studio; options behind ``?``, see
            :func:`torchface.io.protocols.stream_address.parse_address`.
        names: of the weights that come, (N,).
        fps: frames a second.

    Raises:
        ValueRangeError: the address is none, or its host is not known or not reached; or ``fps`` is no camera's.
        NameMismatchError: the protocol cannot carry weights by these names.

    Example:
        >>> sender = open_sender("vmc://127.0.0.1:39539?rate=30", ["jawOpen", "browInnerUp"], fps=60.0)
        >>> nobody_refused = sender.send(torch.tensor([0.5, 0.0]))
        >>> sender.close()
    """
    parts = parse_address(address)
    if parts.scheme == "vts":
        resolved(parts, address)
        token = checked_token_file(parts.options["token"], address) if "token" in parts.options else None
        return VTubeStudioSender(address, parts.host, parts.port, names, token, parts.rate() or 60.0)
    return WeightSender(address, _encode(parts, names, fps), parts.rate())


def _encode(parts: StreamAddress, names: Sequence[str], fps: float) -> Encode:
    if parts.scheme == "vmc":
        return VmcPackets(names, parts.namings() or NAMINGS[:3])
    if parts.scheme == "osc":
        return OscPackets(names, parts.path)
    if parts.scheme == "vrchat":
        return VrchatPackets(names, parts.namings() or VRCHAT_NAMINGS[:3])
    if parts.scheme == "ifacialmocap":
        return IFacialMocapPackets(names)
    return LiveLinkPackets(names, fps, parts.options.get("subject", "torchface"))
