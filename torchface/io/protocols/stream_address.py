"""Addresses of streams, where faces are sent to and received from: ``SCHEME://HOST:PORT/PATH?OPTION=VALUE``."""

import re
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torchface.errors import ValueRangeError
from torchface.io.protocols.ifacialmocap_packets import IFACIALMOCAP_PORT
from torchface.io.protocols.live_link_packets import LIVE_LINK_PORT
from torchface.io.protocols.vmc_packets import NAMINGS, VMC_PORT
from torchface.io.protocols.vrchat_packets import VRCHAT_NAMINGS, VRCHAT_PORT
from torchface.io.protocols.vtube_studio import VTUBE_STUDIO_PORT

DEFAULT_PORTS = {
    "livelink": LIVE_LINK_PORT,
    "vmc": VMC_PORT,
    "ifacialmocap": IFACIALMOCAP_PORT,
    "vrchat": VRCHAT_PORT,
    "vts": VTUBE_STUDIO_PORT,
}
"""Where receivers listen unless they are set up otherwise; the other schemes' addresses name their port."""

SENT = ("udp", "livelink", "vmc", "osc", "ifacialmocap", "vrchat", "vts")
RECEIVED = ("livelink", "ifacialmocap", "vmc", "osc")

_OPTIONS = {
    **dict.fromkeys(("udp", "livelink"), ("rate", "map", "subject")),
    **dict.fromkeys(("vmc", "vrchat"), ("rate", "map", "names")),
    **dict.fromkeys(("osc", "ifacialmocap"), ("rate", "map")),
    "vts": ("rate", "map", "token"),
}
_NAMINGS = {"vmc": NAMINGS, "vrchat": VRCHAT_NAMINGS}
_MOST_RATE = 1000.0
_ADDRESS = re.compile(
    r"(?P<scheme>[a-z]+)://(?P<host>\[[0-9a-fA-F:.]+\]|[^:/?\[\]\s]*)(?::(?P<port>[0-9]{1,5}))?"
    r"(?P<path>/[!->@-~]*)?(?:\?(?P<options>[ -~]*))?"
)
_EXPECTED = (
    "expected an address such as udp://127.0.0.1:11111 or livelink://127.0.0.1:11111 (Live Link Face), "
    "vmc://127.0.0.1:39539, osc://127.0.0.1:9000/torchface, ifacialmocap://127.0.0.1:49983, vrchat://127.0.0.1:9000 or "
    "vts://127.0.0.1:8001 (VTube Studio), the port 1 to 65535"
)
_EXPECTED_SOURCE = (
    "expected what receives a face: livelink://:11111, ifacialmocap://PHONE, vmc://:39539 or osc://:9000/PREFIX, the "
    "port 1 to 65535"
)


@dataclass(frozen=True)
class StreamAddress:
    """The parts of an address; the path has no slash at its end and may be empty."""

    scheme: str
    host: str
    port: int
    path: str = ""
    options: Mapping[str, str] = field(default_factory=dict)

    def rate(self) -> float | None:
        """Frames a second at most; None for all."""
        return float(self.options["rate"]) if "rate" in self.options else None

    def namings(self) -> tuple[str, ...] | None:
        """Which names are sent; None for the protocol's own choice."""
        return tuple(self.options["names"].split("+")) if "names" in self.options else None


def is_source(text: str) -> bool:
    """Whether a text is meant as an address, and not as a camera's number or a path."""
    return "://" in text


def parse_address(address: str) -> StreamAddress:
    """The parts of an address that is sent to.

    Options stand behind ``?``, divided by ``&``: ``rate`` (frames a second at most), ``map`` (a mapping table),
    ``names`` (for ``vmc`` and ``vrchat``, several divided by ``+``), ``subject`` (Live Link Face), ``token`` (a file,
    VTube Studio).
    """
    parts = _parts(address, SENT, _EXPECTED, 1)
    if not parts.host or (parts.path and parts.scheme != "osc"):
        raise ValueRangeError(f"stream: found {address!r:.200}, {_EXPECTED}")
    unknown = sorted(set(parts.options) - set(_OPTIONS[parts.scheme]))
    if unknown:
        raise ValueRangeError(
            f"stream: found the option {unknown[0]!r:.40} in {address!r:.200}, expected of {parts.scheme} "
            f"{', '.join(_OPTIONS[parts.scheme])}"
        )
    try:
        rate = parts.rate()
    except ValueError:
        rate = 0.0
    if rate is not None and not 0 < rate <= _MOST_RATE:
        raise ValueRangeError(f"stream: found {address!r:.200}, expected a rate up to {_MOST_RATE:.0f} frames a second")
    for naming in parts.namings() or ():
        if naming not in _NAMINGS[parts.scheme]:
            raise ValueRangeError(
                f"stream: found names={naming!r:.40} in {address!r:.200}, expected some of "
                f"{', '.join(_NAMINGS[parts.scheme])}, divided by +"
            )
    return parts


def parse_source(address: str) -> StreamAddress:
    """The parts of an address that is received at; without a host all of this machine's addresses are listened at.

    Port 0 is any that is free.
    """
    parts = _parts(address, RECEIVED, _EXPECTED_SOURCE, 0)
    if parts.options or (parts.path and parts.scheme != "osc"):
        raise ValueRangeError(f"stream: found {address!r:.200}, {_EXPECTED_SOURCE}")
    return parts


def resolved(parts: StreamAddress, address: str) -> tuple[socket.AddressFamily, Any]:
    """Family and socket address, the host looked up."""
    try:
        family, _, _, _, target = socket.getaddrinfo(parts.host, parts.port, type=socket.SOCK_DGRAM)[0]
    except (OSError, ValueError) as error:  # ValueError: a name that no host can have, such as a..b
        raise ValueRangeError(f"stream: found {address!r:.200}, whose host is not known ({error})") from error
    return family, target


def _parts(address: str, schemes: tuple[str, ...], expected: str, least: int) -> StreamAddress:
    match = _ADDRESS.fullmatch(address)
    if match is None or match["scheme"] not in schemes:
        raise ValueRangeError(f"stream: found {address!r:.200}, {expected}")
    scheme, path = match["scheme"], (match["path"] or "").rstrip("/")
    port = int(match["port"]) if match["port"] else DEFAULT_PORTS.get(scheme, -1)
    pairs = [pair.partition("=") for pair in (match["options"] or "").split("&") if pair]
    if not least <= port < 65536 or not all(name and value for name, _, value in pairs):
        raise ValueRangeError(f"stream: found {address!r:.200}, {expected}")
    return StreamAddress(scheme, match["host"].strip("[]"), port, path, {name: value for name, _, value in pairs})
