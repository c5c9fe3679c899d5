"""One frame of weights to several receivers, none of which can end the session."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from types import TracebackType

from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.io.protocols.weight_sender import WeightSender, open_sender


class WeightStreams:
    """Senders to several addresses.

    Args:
        addresses: see :func:`torchface.io.open_sender`.
        names: of the weights, (N,).
        fps: frames a second.
        say: called once with a receiver that refuses packets, or that the network no longer reaches.
    """

    def __init__(self, addresses: Sequence[str], names: Sequence[str], fps: float, say: Callable[[str], None]) -> None:
        self._say, self._sent = say, 0
        self._senders: dict[str, WeightSender] = {}
        self._lost = dict.fromkeys(addresses, 0)
        with ExitStack() as opened:
            for address in self._lost:
                self._senders[address] = open_sender(address, names, fps)
                opened.callback(self._senders[address].close)
            self._opened = opened.pop_all()

    def send(self, weights: Tensor, rotations: Tensor) -> None:
        """Sends a frame: weights (N,), Live Link Face's rotations (9,)."""
        self._sent += 1
        for address, sender in self._senders.items():
            try:
                arrived, why = sender.send(weights, rotations), "nobody listens there yet"
            except ValueRangeError as error:  # a network that was reached before
                arrived, why = False, str(error)
            if not arrived:
                self._lost[address] += 1
                if self._lost[address] == 1:
                    self._say(f"{address}: {why}; sending goes on")

    def notes(self) -> tuple[str, ...]:
        """How many frames were lost, a sentence for each receiver that lost any."""
        return tuple(
            f"{address}: {lost} of {self._sent} frames were not received, expected a program that listens there"
            for address, lost in self._lost.items()
            if lost
        )

    def __enter__(self) -> WeightStreams:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._opened.close()
