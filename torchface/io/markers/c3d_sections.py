"""The header and the parameter section of C3D files, which describe the data.

Source: The C3D File Format User Guide, Motion Lab Systems.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchface.errors import FileFormatError, ValueRangeError

BLOCK = 512
INTEL, DEC, MIPS = 84, 85, 86
_MAGIC = 0x50
_MAX_BLOCKS = 255


@dataclass(frozen=True)
class Header:
    """The first block: counts a frame, the frame range, scale, and where the data begin (a block number from 1)."""

    points: int
    analog: int
    first_frame: int
    last_frame: int
    scale: float
    data_block: int
    rate: float


@dataclass(frozen=True)
class Parameter:
    """One value of the parameter section: characters (-1), bytes (1), 16-bit integers (2) or floats (4)."""

    kind: int
    dimensions: tuple[int, ...]
    data: bytes


@dataclass(frozen=True)
class Sections:
    """A file's description of itself; parameters go by ``GROUP:NAME`` in capitals."""

    processor: int
    header: Header
    parameters: dict[str, Parameter]

    def numbers(self, name: str) -> list[float]:
        """A parameter's numbers; none where it is absent. Integers count from 0 up."""
        parameter = self.parameters.get(name)
        if parameter is None or parameter.kind == -1:
            return []
        order = ">" if self.processor == MIPS else "<"
        if parameter.kind == 4:
            return floats(parameter.data, self.processor).tolist()
        return np.frombuffer(parameter.data, np.dtype(f"{order}u{parameter.kind}")).tolist()

    def texts(self, name: str) -> list[str]:
        """A parameter's texts without the blanks that fill them up; none where it is absent."""
        parameter = self.parameters.get(name)
        if parameter is None or parameter.kind != -1 or not parameter.data:
            return []
        width = parameter.dimensions[0] if parameter.dimensions else 1
        return [_decode(parameter.data[i : i + width]) for i in range(0, len(parameter.data), width)]


def floats(data: bytes | np.ndarray, processor: int) -> np.ndarray:
    """32-bit floats of a processor, as the machine's own."""
    if processor == MIPS:
        return np.frombuffer(data, ">f4").astype(np.float32)
    if processor == DEC:  # the 16-bit halves stand the other way round, and the exponent counts two more
        halves = np.frombuffer(data, "<u2").reshape(-1, 2)[:, ::-1]
        return np.ascontiguousarray(halves).view("<f4")[:, 0] * np.float32(0.25)
    return np.frombuffer(data, "<f4").astype(np.float32)


def _decode(data: bytes) -> str:
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    return text.rstrip(" \0")


def read_sections(data: bytes, path: Path) -> Sections:
    """Reads header and parameters from a whole file."""
    if len(data) < 2 * BLOCK or data[1] != _MAGIC or data[0] < 2:
        raise FileFormatError(
            f"{path}: found no C3D header, expected byte 2 to be 80 and a file of 1,024 bytes or more"
        )
    start = (data[0] - 1) * BLOCK
    if start + 4 > len(data):
        raise FileFormatError(
            f"{path}: found {len(data)} bytes, expected the parameter section at byte {start}; is the file cut off?"
        )
    blocks, processor = data[start + 2], data[start + 3]
    if processor not in (INTEL, DEC, MIPS):
        raise FileFormatError(f"{path}: found processor type {processor}, expected 84 (Intel), 85 (DEC) or 86 (MIPS)")
    order = ">" if processor == MIPS else "<"
    points, analog, first_frame, last_frame = struct.unpack_from(order + "4H", data, 2)
    (data_block,) = struct.unpack_from(order + "H", data, 16)
    scale, rate = (float(floats(data[at : at + 4], processor)[0]) for at in (12, 20))
    header = Header(points, analog, first_frame, last_frame, scale, data_block, rate)
    stop = min(len(data), start + BLOCK * (blocks or _MAX_BLOCKS))
    return Sections(processor, header, _read_parameters(data[start + 4 : stop], order, path))


def _read_parameters(section: bytes, order: str, path: Path) -> dict[str, Parameter]:
    groups: dict[int, str] = {}
    entries: list[tuple[int, str, Parameter]] = []
    at = taken = 0
    while at + 2 <= len(section):
        length, group = struct.unpack_from("bb", section, at)
        if length == 0 or group == 0:
            break
        name = _decode(section[at + 2 : at + 2 + abs(length)]).strip().upper()
        at += 2 + abs(length)  # the length is negative where the name is locked
        if at + 2 > len(section):
            raise FileFormatError(f"{path}: found the parameter section cut off within {name[:40]!r}")
        (offset,) = struct.unpack_from(order + "H", section, at)
        if group < 0:
            groups[-group] = name
        else:
            entries.append((group, name, _read_parameter(section, at + 2, name, path)))
            taken += len(entries[-1][2].data)
            if taken > len(section):
                raise FileFormatError(f"{path}: parameter {name[:40]!r}: found it to overlap others, expected it apart")
        if offset == 0:
            break
        if offset < 2:
            raise FileFormatError(
                f"{path}: parameter {name[:40]!r}: found the next {offset} bytes on, expected 2 or more"
            )
        at += offset
    return {f"{groups.get(group, '')}:{name}": parameter for group, name, parameter in entries}


def _read_parameter(section: bytes, at: int, name: str, path: Path) -> Parameter:
    kind, count = struct.unpack("bB", section[at : at + 2]) if at + 2 <= len(section) else (0, 0)
    dimensions = tuple(section[at + 2 : at + 2 + count])
    size = abs(kind)
    for dimension in dimensions:
        size = min(size * dimension, len(section) + 1)  # up to 255 factors of 255: the product must not grow
    at += 2 + count
    if kind not in (-1, 1, 2, 4):
        raise FileFormatError(f"{path}: parameter {name[:40]!r}: found data type {kind}, expected -1, 1, 2 or 4")
    if len(dimensions) != count or at + size > len(section):
        raise FileFormatError(f"{path}: parameter {name[:40]!r}: found it to run past the end of the parameter section")
    return Parameter(kind, dimensions, section[at : at + size])


def pack_sections(header: Header, groups: dict[str, dict[str, Parameter]], path: Path) -> bytes:
    """Header and parameter section for data that begin right behind them, Intel byte order.

    Both ``header.data_block`` and ``POINT:DATA_START`` are filled in here.
    """

    def section(data_block: int) -> bytes:
        start = {"DATA_START": Parameter(2, (), struct.pack("<H", data_block))}
        return b"".join(
            _pack_group(number + 1, name, {**parameters, **(start if name == "POINT" else {})})
            for number, (name, parameters) in enumerate(groups.items())
        )

    blocks = -(-(4 + len(section(0)) + 2) // BLOCK)  # at least two zeros mark the end
    if blocks > _MAX_BLOCKS:
        raise ValueRangeError(
            f"{path}: found labels that fill {blocks} blocks of 512 bytes, expected at most {_MAX_BLOCKS}"
        )
    first = struct.pack(
        "<BB5HfHHf",
        *(2, _MAGIC, header.points, header.analog, min(header.first_frame, 65535), min(header.last_frame, 65535), 0),
        *(header.scale, 2 + blocks, 0, header.rate),
    )
    parameters = struct.pack("<BBBB", 1, _MAGIC, blocks, INTEL) + section(2 + blocks)
    return first.ljust(BLOCK, b"\0") + parameters.ljust(BLOCK * blocks, b"\0")


def _pack_group(number: int, name: str, parameters: dict[str, Parameter]) -> bytes:
    packed = struct.pack("<bb", len(name), -number) + name.encode("ascii") + struct.pack("<HB", 3, 0)
    for label, value in parameters.items():
        body = struct.pack("<bB", value.kind, len(value.dimensions)) + bytes(value.dimensions) + value.data + b"\0"
        packed += struct.pack("<bb", len(label), number) + label.encode("ascii")
        packed += struct.pack("<H", 2 + len(body)) + body
    return packed
