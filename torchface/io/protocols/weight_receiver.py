"""Receiver of faces by UDP: what an iPhone or another program sends, decoded, checked and put in order."""

import errno
import re
import select
import socket
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from torchface.errors import TorchfaceError, ValueRangeError
from torchface.escaped_text import visible
from torchface.io.protocols.ifacialmocap_packets import START, read_ifacialmocap
from torchface.io.protocols.live_link_packets import read_live_link
from torchface.io.protocols.osc_packets import OscReader
from torchface.io.protocols.received_face import ReceivedFace
from torchface.io.protocols.stream_address import StreamAddress, parse_source, resolved
from torchface.io.protocols.vmc_packets import VmcReader

_FAR = 300  # frames; a number so much further, or so much earlier, is a clock that was set
_SET = 0.2  # seconds: no network holds frames back for longer; older numbers after that are a clock that was set
_QUICKEST = 240  # frames a second that a clock counts on while its app sends nothing
_RECENT = 30
_FREE = 2.0  # seconds after which another sender may take over
_PORTS = 8  # of a sender that are remembered
_OTHER_PORTS = 4  # so many different ones, one after another, are of one that sends each frame from another port
_NAMED = 5  # addresses


@dataclass
class PacketCounts:
    """What packets came."""

    packets: int = 0  # of whatever kind
    first: bytes = b""  # bytes of the last one
    taken: int = 0
    lost: int = 0
    late: int = 0  # those that came after a newer one
    others: int = 0  # of a second sender while the first was there
    jumps: int = 0  # how often the sender's count was set
    malformed: int = 0  # packets that are none of the protocol
    fault: str = ""  # what is wrong with the last of these
    unused: dict[str, None] = field(default_factory=dict)  # addresses of OSC that move nothing, in their order

    def words(self) -> str:
        """What went wrong, for people; empty if nothing did."""
        names = {"lost": "lost", "late": "late", "others": "of another sender"}
        names["jumps"] = "jump of its clock" if self.jumps == 1 else "jumps of its clock"
        found = [f"{getattr(self, name)} {words}" for name, words in names.items() if getattr(self, name)]
        if self.malformed:
            found.append(f"{self.malformed} not understood ({self.fault})")
        if self.unused:
            some = [visible(address) for address in list(self.unused)[:_NAMED]]
            more = ", ..." if len(self.unused) > _NAMED else ""
            what = "1 address that moves" if len(self.unused) == 1 else f"{len(self.unused)} addresses that move"
            found.append(f"{what} no shape ({', '.join(some)}{more})")
        return ", ".join(found)


class FrameOrder:
    """Says of each frame whether it is the next one to show."""

    def __init__(self) -> None:
        self.counts = PacketCounts()
        self.sender = ""
        self._last: int | None = None
        self._before: int | None = None  # of the clock that was in use until it jumped
        self._stands = False  # whether the sender's clock does not go on
        self._heard = self._taken = self._jumped = float("-inf")
        self._steps: deque[int] = deque(maxlen=_RECENT)
        self._ports: deque[int] = deque(maxlen=_PORTS)
        self._port: int | None = None  # of the sender, once it has sent twice from one

    @property
    def knows_port(self) -> bool:
        """Whether the sender sends from one port."""
        return self._port is not None

    def takes(self, sender: str, number: int | None, now: float, port: int = 0) -> bool:
        """Whether a frame is taken, by the sender's number, if it counts, and the time in seconds; counts it.

        Two programs of one name and address are distinguished by their ports; one that sends each frame from another
        port is one sender.
        """
        if sender != self.sender or (self._port is not None and port != self._port):
            if now - self._heard < _FREE and not self._changes_ports(sender, port):
                self.counts.others += 1
                return False
            self.sender, self._last, self._before = sender, None, None
            self._steps.clear()
            self._ports.clear()
            self._port = None
        if self._port is None and port in self._ports:
            self._port = port
        self._ports.append(port)
        self._heard = now
        if number is not None and self._last is not None:
            step = number - self._last
            back = -_FAR < step <= 0 and now - self._taken < _SET and not (step == 0 and self._stands)
            old = self._before is not None and now - self._jumped < _SET and abs(number - self._before) < _FAR
            if back or (old and abs(step) >= _FAR):
                self.counts.late += 1
                return False
            self._stands = step == 0
            paused = 0 < step <= _QUICKEST * (now - self._taken)
            if step < 0 or (step >= _FAR and not paused):
                self.counts.jumps += 1
                self._before, self._jumped = self._last, now
                self._steps.clear()
            elif 0 < step < _FAR:
                self._steps.append(step)
                # A phone at half its clock's rate counts every other one.
                usual = sorted(self._steps)[len(self._steps) // 4]
                self.counts.lost += max(0, round(step / usual) - 1)
        self._last, self._taken = number, now
        self.counts.taken += 1
        return True

    def _changes_ports(self, sender: str, port: int) -> bool:
        """Whether the sender has no port of its own after all: one of those that it uses came twice by chance."""
        if sender != self.sender:
            return False
        self._ports.append(port)
        last = list(self._ports)[-_OTHER_PORTS:]
        return self._port not in last and len(set(last)) == _OTHER_PORTS


Read = Callable[[bytes], list[ReceivedFace]]  # faces of a packet; raises TorchfaceError where it is malformed

_LARGEST_PACKET = 65536
_ASK_AGAIN = 2.0  # seconds without a packet after which the app is asked to send
_MOST_SENDERS = 16
_MOST_AT_ONCE = 256  # packets between two looks at the clock
_FIRST = 32  # bytes by which a packet's kind is known


class WeightReceiver:
    """Listens for faces.

    Args:
        address: ``livelink://:11111``, ``ifacialmocap://PHONE`` (which is asked to send), ``vmc://:39539``,
            ``osc://:9000/PREFIX``. A host is one of this machine's addresses, for ``ifacialmocap`` the phone's.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        parts = parse_source(address)
        self.scheme = parts.scheme
        self._read: dict[tuple[str, int], Read] = {}
        self._order = FrameOrder()
        self.counts = self._order.counts
        self._make = _readers(parts, self.counts.unused)
        self._phone, self._asked, self._heard = None, float("-inf"), float("-inf")
        if parts.scheme == "ifacialmocap" and parts.host:
            family, self._phone = resolved(parts, address)
            local = _facing(family, self._phone)
        elif parts.host:
            family, _ = resolved(parts, address)
            local = parts.host
        else:
            family, local = _any_family(), ""
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            if family == socket.AF_INET6 and not parts.host:
                self._socket.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
            self._socket.bind((local, parts.port))
        except OSError as error:
            self._socket.close()
            why = (
                f"another program has port {parts.port}; end it, or have the sender use another port"
                if error.errno == errno.EADDRINUSE
                else f"{error.strerror or error}; expected one of this machine's addresses"
            )
            raise ValueRangeError(f"stream: cannot receive at {address} ({why})") from error
        self._socket.setblocking(False)
        host, self.port = self._socket.getsockname()[:2]
        self.host = "" if host in ("0.0.0.0", "::") else str(host)  # of this machine's addresses; empty: all

    def faces(self, seconds: float) -> list[tuple[float, ReceivedFace]]:
        """The faces that have come, in order, and when; waits so many seconds for the first."""
        self._ask()
        end = time.perf_counter() + seconds
        while not (found := self._arrived(max(0.0, end - time.perf_counter()))) and time.perf_counter() < end:
            pass  # of a face that comes in several packets not all are there
        return found

    def _arrived(self, seconds: float) -> list[tuple[float, ReceivedFace]]:
        """The faces of the packets that have come; waits for the first packet."""
        select.select([self._socket], [], [], seconds)
        found = list[tuple[float, ReceivedFace]]()
        for _ in range(_MOST_AT_ONCE):
            try:
                packet, (host, port, *_) = self._socket.recvfrom(_LARGEST_PACKET)
            except BlockingIOError:
                break
            except ConnectionError:  # the phone does not listen yet: the system reports what was asked before
                continue
            now, host = time.perf_counter(), host.removeprefix("::ffff:")  # what IPv6 makes of IPv4
            found += [(now, face) for face in self._faces(packet, (host, port), now)]
        return found

    def _faces(self, packet: bytes, came: tuple[str, int], now: float) -> list[ReceivedFace]:
        host, port = came
        self.counts.packets += 1
        self.counts.first = packet[:_FIRST]
        try:
            faces = self._reader(host, port)(packet)
            if not self._order.knows_port:  # else one program may send each part of a face from another port
                faces = self._reader(host, 0)(packet)
        except TorchfaceError as error:
            self.counts.malformed += 1
            self.counts.fault = str(error).removeprefix("packet: ")[:120]
            return []
        taken = [face for face in faces if self._order.takes(f"{face.subject} {host}", face.number, now, port)]
        if taken:
            self._heard = now
        return taken

    def _reader(self, host: str, port: int) -> Read:
        """The reader of a sender, as what each sends in parts is kept apart."""
        came = host, port
        read = self._read[came] = self._read.pop(came) if came in self._read else self._make()
        if len(self._read) > _MOST_SENDERS:  # of which one may send from a new port each time
            del self._read[next(iter(self._read))]
        return read

    @property
    def asks(self) -> bool:
        """Whether somebody is asked to send."""
        return self._phone is not None

    @property
    def sender(self) -> str:
        """Whom faces are taken from: name and address."""
        return self._order.sender

    def _ask(self) -> None:
        now = time.perf_counter()
        if self._phone is None or now - max(self._asked, self._heard) < _ASK_AGAIN:
            return
        self._asked = now
        with suppress(OSError):  # asked again later: phones come and go
            self._socket.sendto(START, self._phone)

    def close(self) -> None:
        """Gives the port back."""
        self._socket.close()

    def __enter__(self) -> "WeightReceiver":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def packet_kind(first: bytes) -> tuple[str, str]:
    """What a packet looks like by its first bytes, for people, and the scheme that it is received with, if any."""
    address = first[20:] if first.startswith(b"#bundle\0") else first
    if address.startswith(b"/"):
        return ("VMC", "vmc") if address.startswith(b"/VMC/") else ("OSC", "osc")
    if first.startswith(b"\6\0\0\0"):
        return "Live Link Face", "livelink"
    text = first.decode("ascii", "replace")
    if re.match(r"=?[A-Za-z_]+[-&#]-?[0-9]", text):
        return "iFacialMocap", "ifacialmocap"
    return (f"text ({text[:16]!r})" if text.isprintable() else f"bytes {first[:4].hex(' ')}"), ""


def _readers(parts: StreamAddress, unused: dict[str, None]) -> Callable[[], Read]:
    if parts.scheme == "vmc":
        return VmcReader
    if parts.scheme == "osc":
        return lambda: OscReader(parts.path, unused)
    read = read_live_link if parts.scheme == "livelink" else read_ifacialmocap
    return lambda: read


def _facing(family: socket.AddressFamily, target: Any) -> str:
    """This machine's address that another one sees; all of them where no way leads there."""
    with socket.socket(family, socket.SOCK_DGRAM) as probe, suppress(OSError):
        probe.connect(target)
        return str(probe.getsockname()[0])
    return ""


def _any_family() -> socket.AddressFamily:
    """One that hears both kinds of addresses, where the system has it."""
    return socket.AF_INET6 if socket.has_dualstack_ipv6() else socket.AF_INET
