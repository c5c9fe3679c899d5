"""One frame of weights to several receivers, none of which can end the session."""

import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from torch import Tensor

from torchface.capture.retargeting import ShapeMap, load_shape_rules, shape_map
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.io.protocols.stream_address import parse_address
from torchface.io.protocols.weight_sender import FrameSender, open_sender

_MAP = re.compile(r"(?<=[?&])map=[^&]*&?")


class MappedSender:
    """A sender that gets weights by other names, after a mapping table."""

    def __init__(self, sender: FrameSender, shapes: ShapeMap) -> None:
        self._sender, self._shapes, self.address = sender, shapes, sender.address

    @property
    def problem(self) -> str:
        """Why frames do not arrive."""
        return self._sender.problem

    def send(self, weights: Tensor, rotations: Tensor | None = None) -> bool:
        """Sends one frame: weights (N,), rotations (9,)."""
        return self._sender.send(self._shapes(weights.nan_to_num(0.0)[None])[0], rotations)

    def close(self) -> None:
        """Closes the sender."""
        self._sender.close()


def mapped_sender(address: str, names: Sequence[str], fps: float) -> FrameSender | MappedSender:
    """A sender to an address, after the mapping table that its option ``map`` names.

    The table's names are what VMC, VRChat and plain OSC then send; the other protocols have names of their own, which
    must be among them.
    """
    parts = parse_address(address)
    if "map" not in parts.options:
        return open_sender(address, names, fps)
    path = Path(parts.options["map"]).expanduser()
    rules = load_shape_rules(path)
    try:
        shapes = shape_map(names, tuple(rules), rules)
    except NameMismatchError as error:
        raise NameMismatchError(f"{path}: {error}") from error
    plain = _MAP.sub("", address).rstrip("?&")
    if parts.scheme in ("vmc", "vrchat") and "names" not in parts.options:
        plain += ("&" if "?" in plain else "?") + "names=own"
    return MappedSender(open_sender(plain, tuple(rules), fps), shapes)


class WeightStreams:
    """Senders to several addresses; says once which receiver refuses packets, or is not reached any more."""

    def __init__(self, addresses: Sequence[str], names: Sequence[str], fps: float, say: Callable[[str], None]) -> None:
        self._say, self._sent = say, 0
        self._senders: dict[str, FrameSender | MappedSender] = {}
        self._lost = dict.fromkeys(addresses, 0)
        self._said: dict[str, str] = {}
        with ExitStack() as opened:
            for address in self._lost:
                self._senders[address] = mapped_sender(address, names, fps)
                opened.callback(self._senders[address].close)
            self._opened = opened.pop_all()

    def send(self, weights: Tensor, rotations: Tensor) -> None:
        """Sends a frame: weights (N,), Live Link Face's rotations (9,)."""
        self._sent += 1
        for address, sender in self._senders.items():
            try:
                arrived, why = sender.send(weights, rotations), sender.problem
            except ValueRangeError as error:  # a network that was reached before
                arrived, why = False, str(error)
            if not arrived:
                self._lost[address] += 1
                if why != self._said.get(address):
                    self._said[address] = why
                    self._say(f"{address}: {why}; sending goes on")

    def notes(self) -> tuple[str, ...]:
        """How many frames were lost, a sentence for each receiver that lost any."""
        return tuple(
            f"{address}: {lost} of {self._sent} frames were not received, expected a program that listens there"
            for address, lost in self._lost.items()
            if lost
        )

    def __enter__(self) -> "WeightStreams":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._opened.close()
