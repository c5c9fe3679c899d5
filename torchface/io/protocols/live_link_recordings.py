"""Recordings of Live Link Face's packets as they were sent: ``.gesichter``, gzip of sizes and packets."""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file
from torchface.io.protocols.live_link_packets import packet_rate, read_live_link
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT
from torchface.take import Take, Track

_MOST_PACKED, _MOST_BYTES = 2**26, 2**27  # the latter is two hours of 60 frames a second
_HEAD, _SIZE = struct.Struct("!BI"), struct.Struct("!I")
_LARGEST_PACKET = 2048


def recorded_packets(path: str | Path) -> Iterator[bytes]:
    """The packets of a recording, in their order.

    The file is gzip of the version, one byte, the number of packets, and of each packet its size and bytes, sizes and
    number four bytes, the highest first.
    """
    path = Path(path)
    unpack = zlib.decompressobj(31)
    try:
        data = unpack.decompress(read_file(path, _MOST_PACKED), _MOST_BYTES)
    except zlib.error as error:
        raise FileFormatError(f"{path}: found no gzip ({error}), expected packets of Live Link Face") from error
    if unpack.unconsumed_tail or not unpack.eof:
        raise FileFormatError(f"{path}: found gzip that is cut off or larger than {_MOST_BYTES} bytes, expected less")
    if len(data) < _HEAD.size:
        raise FileFormatError(f"{path}: found {len(data)} bytes, expected version and number of packets")
    (_, count), at = _HEAD.unpack_from(data), _HEAD.size
    for number in range(count):
        size = _SIZE.unpack_from(data, at)[0] if at + _SIZE.size <= len(data) else 0
        at += _SIZE.size
        if not 0 < size <= min(_LARGEST_PACKET, len(data) - at):
            raise FileFormatError(
                f"{path}: packet {number + 1} of {count}: found a size of {size}, expected a whole one"
            )
        yield data[at : at + size]
        at += size


def load_live_link_packets(path: str | Path) -> Take:
    """Reads a recording as a take; frames that were lost on the way are gaps in its times.

    Frames that came late or twice are put in order. Those of no face are NaN.

    Returns:
        weights (T,52,1) by ARKit's names; head and eye rotations in ``extras["columns"]``, radians.
    """
    rows, rate = dict[int, np.ndarray](), 0.0
    for number, packet in enumerate(recorded_packets(path), 1):
        try:
            (face,) = read_live_link(packet)
            rate = rate or packet_rate(packet)
        except FileFormatError as error:
            raise FileFormatError(f"{path}: packet {number}: {error}") from error
        weights = face.weights if face.found else torch.full_like(face.weights, torch.nan)
        rows[face.number or 0] = torch.cat([weights, face.rotations]).numpy()
    if not rows:
        raise FileFormatError(f"{path}: found no packet, expected a frame at least")
    numbers = np.sort(np.fromiter(rows, np.int64))
    values = np.stack([rows[number] for number in numbers.tolist()])
    columns = {name: torch.from_numpy(values[:, len(ARKIT) + i].astype(np.float64)) for i, name in enumerate(ROTATIONS)}
    track = Track(ARKIT, torch.from_numpy(values[:, : len(ARKIT), None].copy()))
    whole = numbers[-1] - numbers[0] == len(numbers) - 1
    seconds = None if whole else torch.from_numpy((numbers - numbers[0]) / rate)
    return Take(rate, weights=track, extras={"columns": columns}, seconds=seconds)
