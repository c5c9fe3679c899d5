"""Messages received by python-osc's own server, in their order."""

from collections import defaultdict
from typing import Any

from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_packet import OscPacket
from pythonosc.osc_server import BlockingOSCUDPServer


class OscReceiver:
    """python-osc's server on a port of its own; keeps every message in its order."""

    def __init__(self) -> None:
        dispatcher = Dispatcher()
        dispatcher.set_default_handler(self._take)
        self.server = BlockingOSCUDPServer(("127.0.0.1", 0), dispatcher)
        self.server.timeout = 5
        self.port = self.server.server_address[1]
        self.messages: list[tuple[str, tuple[Any, ...]]] = []

    def _take(self, address: str, *values: Any) -> None:
        self.messages.append((address, values))

    def receive(self, until: str, count: int = 1) -> list[tuple[str, tuple[Any, ...]]]:
        """Handles packets until so many messages of an address are there."""
        for _ in range(20):
            if sum(address == until for address, _ in self.messages) >= count:
                return self.messages
            self.server.handle_request()
        raise AssertionError(f"{until} did not come: {self.messages}")


def values_by_address(packets: list[bytes]) -> dict[str, list[tuple[Any, ...]]]:
    """What python-osc reads of packets: for each address the values of its messages."""
    found: dict[str, list[tuple[Any, ...]]] = defaultdict(list)
    for packet in packets:
        for message in OscPacket(packet).messages:
            found[message.message.address].append(tuple(message.message.params))
    return found
