"""Messages of Open Sound Control as bytes, and bytes as messages."""

import struct
from collections.abc import Iterable, Iterator

from torchface.errors import FileFormatError

Value = str | int | float | bool
Message = tuple[str, tuple[Value | bytes | None, ...]]  # an address and its values

LARGEST_IN_ETHERNET = 1400  # bytes of a packet, which one Ethernet frame must hold
LARGEST = 60_000  # what UDP carries

_BUNDLE, _AT_ONCE = b"#bundle\0", struct.pack(">Q", 1)
_MOST_MESSAGES, _MOST_VALUES, _DEEPEST = 4096, 256, 4
_NUMBERS = {"i": struct.Struct(">i"), "f": struct.Struct(">f"), "d": struct.Struct(">d"), "h": struct.Struct(">q")}
_WITHOUT_BYTES = {"T": True, "F": False, "N": None, "I": None}


def osc_message(address: str, *values: Value) -> bytes:
    """A message; floats have 32 bits."""
    kinds, data = ",", b""
    for value in values:
        if isinstance(value, bool):
            kinds += "T" if value else "F"
        elif isinstance(value, str):
            kinds, data = kinds + "s", data + _padded(value)
        else:
            kind = "i" if isinstance(value, int) else "f"
            kinds, data = kinds + kind, data + _NUMBERS[kind].pack(value)
    return _padded(address) + _padded(kinds) + data


def osc_bundles(messages: Iterable[bytes], largest: int = LARGEST) -> list[bytes]:
    """Messages in bundles of at most so many bytes, in their order, to be done at once."""
    packets, bundle = list[bytes](), bytearray(_BUNDLE + _AT_ONCE)
    for message in messages:
        if len(bundle) + 4 + len(message) > largest:
            packets.append(bytes(bundle))
            bundle = bytearray(_BUNDLE + _AT_ONCE)
        bundle += struct.pack(">i", len(message)) + message
    return [*packets, bytes(bundle)]


def read_osc(packet: bytes) -> list[Message]:
    """The messages of a packet, those of bundles in their order."""
    messages = []
    try:
        for message in _messages(packet, 0):
            messages.append(message)
            if len(messages) > _MOST_MESSAGES:
                raise _bad(f"more than {_MOST_MESSAGES} messages")
    except (struct.error, UnicodeDecodeError, IndexError, ValueError) as error:
        raise _bad(f"bytes that are no OSC ({error})") from error
    return messages


def _messages(data: bytes, depth: int) -> Iterator[Message]:
    if not data.startswith(_BUNDLE):
        yield _message(data)
        return
    if depth > _DEEPEST:
        raise _bad("bundles in bundles")
    at = len(_BUNDLE) + len(_AT_ONCE)
    if len(data) < at:
        raise _bad("a bundle that is cut off")
    while at < len(data):
        (size,) = _NUMBERS["i"].unpack_from(data, at)
        at += 4
        if size <= 0 or at + size > len(data):
            raise _bad(f"a part of {size} bytes, {len(data) - at} are left")
        yield from _messages(data[at : at + size], depth + 1)
        at += size


def _message(data: bytes) -> Message:
    address, at = _text(data, 0)
    if not address.startswith("/"):
        raise _bad(f"the address {address!r:.40}")
    if at == len(data):  # some old senders write no types where there are no values
        return address, ()
    kinds, at = _text(data, at)
    if not kinds.startswith(",") or len(kinds) > _MOST_VALUES:
        raise _bad(f"the types {kinds!r:.40}")
    values = list[Value | bytes | None]()
    for kind in kinds[1:]:
        if kind in _NUMBERS:
            values.append(_NUMBERS[kind].unpack_from(data, at)[0])
            at += _NUMBERS[kind].size
        elif kind in _WITHOUT_BYTES:
            values.append(_WITHOUT_BYTES[kind])
        elif kind == "s":
            text, at = _text(data, at)
            values.append(text)
        elif kind == "b":
            (size,) = _NUMBERS["i"].unpack_from(data, at)
            if not 0 <= size <= len(data) - at - 4:
                raise _bad(f"a blob of {size} bytes")
            values.append(data[at + 4 : at + 4 + size])
            at += 4 + -(-size // 4) * 4
        else:
            raise _bad(f"a value of type {kind!r}")
    return address, tuple(values)


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode(), at + (end - at) // 4 * 4 + 4


def _padded(text: str) -> bytes:
    data = text.encode()
    return data + b"\0" * (4 - len(data) % 4)


def _bad(found: str) -> FileFormatError:
    return FileFormatError(f"packet: found {found}, expected OSC messages")
