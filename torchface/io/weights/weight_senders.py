"""What sends frames of weights, by the scheme of its address."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from torchface.io.weights.live_link_stream import LiveLinkSender
from torchface.io.weights.osc_stream import OscSender, VmcSender
from torchface.io.weights.udp_sending import parse_address


class WeightSender(Protocol):
    """Sends one frame after another to one place."""

    def send(self, weights: Tensor, rotations: Tensor | None = None) -> bool:
        """Sends weights (N,) and Live Link Face's rotations (9,); whether no frame before was refused."""

    def close(self) -> None:
        """Gives the socket back."""


def open_sender(address: str, names: Sequence[str], fps: float) -> WeightSender:
    """A sender to an address.

    Args:
        address: ``udp://HOST:PORT`` or ``livelink://HOST:PORT`` for Live Link Face's packets, ``vmc://HOST:PORT`` for
            the VMC protocol, ``osc://HOST:PORT/PREFIX`` for plain OSC.
        names: of the weights that come, (N,).
        fps: frames a second.

    Raises:
        ValueRangeError: the address is none, or its host is not known or not reached.
        NameMismatchError: the protocol cannot carry weights by these names.

    Example:
        >>> sender = open_sender("vmc://127.0.0.1:39539", ["jawOpen", "browInnerUp"], fps=60.0)
        >>> nobody_refused = sender.send(torch.tensor([0.5, 0.0]))
        >>> sender.close()
    """
    scheme = parse_address(address).scheme
    if scheme == "vmc":
        return VmcSender(address, names)
    if scheme == "osc":
        return OscSender(address, names)
    return LiveLinkSender(address, names, fps)
