"""What a video's compressed packets tell before they are decoded: when each is shown, and how large its frames are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchface.io.video.decoding import opencv

_START = b"\x00\x00\x01"


@dataclass(frozen=True, eq=False)
class Packets:
    """A video's packets in the order they are stored.

    Args:
        seconds: when each is shown, (P,) float64, from the first's time on; in order of decoding, not of showing.
        sizes: (packet, width, height) of those that say so (key frames of H.264, H.265, VP8, VP9, MPEG-4, JPEG).
    """

    seconds: np.ndarray
    sizes: tuple[tuple[int, int, int], ...]

    def resized(self) -> tuple[int, int, int] | None:
        """The first packet of another size than the first that tells one."""
        return next((one for one in self.sizes if one[1:] != self.sizes[0][1:]), None)


def read_packets(path: Path) -> Packets | None:
    """Reads packets without decoding them; None where the decoder does not hand them out.

    Args:
        path: a file that is known to be a video.
    """
    cv2 = opencv()
    try:
        capture = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    except cv2.error:
        return None
    seconds: list[float] = []
    sizes: list[tuple[int, int, int]] = []
    try:
        if not capture.isOpened() or capture.get(cv2.CAP_PROP_FORMAT) != -1:
            return None
        code = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True).lower()
        while True:  # packets come one by one
            good, packet = capture.read()
            if not good:
                break
            if capture.get(cv2.CAP_PROP_LRF_HAS_KEY_FRAME):
                size = coded_size(code, packet.tobytes())
                if size is not None:
                    sizes.append((len(seconds), *size))
            seconds.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
    except cv2.error:
        return None
    finally:
        capture.release()
    return Packets(np.asarray(seconds, dtype=np.float64), tuple(sizes))


def coded_size(code: bytes, packet: bytes) -> tuple[int, int] | None:
    """Width and height that a key frame's packet tells; None where it tells none.

    Args:
        code: of the codec, four characters in lower case.
        packet: as it is stored; H.264 and H.265 with start codes.

    Source: ITU-T H.264 7.3.2.1, H.265 7.3.2.2, T.81 B.2.2; ISO/IEC 14496-2 6.2.3; RFC 6386 9.1; VP9 bitstream 6.2.
    """
    try:
        if code in (b"h264", b"avc1", b"avc3", b"x264"):
            return _last(_h264(_Bits(unit[1:])) for unit in _units(packet) if unit[0] & 31 == 7)
        if code in (b"hevc", b"h265", b"hvc1", b"hev1", b"x265"):
            return _last(_h265(_Bits(unit[2:])) for unit in _units(packet) if (unit[0] >> 1) & 63 == 33)
        if code in (b"fmp4", b"mp4v", b"xvid", b"divx", b"dx50"):
            return _last(_mpeg4(_Bits(unit[1:])) for unit in _units(packet) if 0x20 <= unit[0] <= 0x2F)
        if code == b"vp80" and packet[3:6] == b"\x9d\x01\x2a":
            return int.from_bytes(packet[6:8], "little") & 0x3FFF, int.from_bytes(packet[8:10], "little") & 0x3FFF
        if code == b"vp90":
            return _vp9(_Bits(packet[:32]))
        if code in (b"mjpg", b"jpeg"):
            return _jpeg(packet)
    except (IndexError, ValueError):
        return None
    return None


class _Bits:
    """Bits from the highest on; emulation prevention bytes are left out."""

    def __init__(self, content: bytes) -> None:
        content = content[:256].replace(b"\x00\x00\x03", b"\x00\x00")
        self._value, self._left = int.from_bytes(content, "big"), 8 * len(content)

    def take(self, count: int) -> int:
        self._left -= count
        if self._left < 0:
            raise ValueError("too few bits")
        return (self._value >> self._left) & ((1 << count) - 1)

    def golomb(self) -> int:
        zeros = 0
        while not self.take(1):
            zeros += 1
            if zeros > 32:
                raise ValueError("no exponential Golomb code")
        return (1 << zeros) - 1 + self.take(zeros)


def _units(packet: bytes) -> Iterator[bytes]:
    """What follows each start code."""
    place = packet.find(_START)
    while place >= 0:
        after = packet.find(_START, place + 3)
        unit = packet[place + 3 : after if after >= 0 else len(packet)]
        if unit:
            yield unit
        place = after


def _last(sizes: Iterator[tuple[int, int] | None]) -> tuple[int, int] | None:
    """The last of several: the container's own header may stand before the one that counts."""
    found = list(sizes)
    return found[-1] if found else None


def _h264(bits: _Bits) -> tuple[int, int]:
    profile = bits.take(8)
    bits.take(16)
    bits.golomb()
    chroma, separate = 1, 0
    if profile in (100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135):
        chroma = bits.golomb()
        separate = bits.take(1) if chroma == 3 else 0
        bits.golomb()
        bits.golomb()
        bits.take(1)
        if bits.take(1):
            for number in range(8 if chroma != 3 else 12):  # scaling lists, each as long as it says itself
                if bits.take(1):
                    _skip_scaling(bits, 16 if number < 6 else 64)
    bits.golomb()
    order = bits.golomb()
    if order == 0:
        bits.golomb()
    elif order == 1:
        bits.take(1)
        bits.golomb()
        bits.golomb()
        for _ in range(min(bits.golomb(), 255)):
            bits.golomb()
    bits.golomb()
    bits.take(1)
    across, down = bits.golomb() + 1, bits.golomb() + 1
    frames_only = bits.take(1)
    if not frames_only:
        bits.take(1)
    bits.take(1)
    width, height = 16 * across, 16 * down * (2 - frames_only)
    if bits.take(1):
        left, right, top, bottom = (bits.golomb() for _ in range(4))
        step_x, step_y = (1, 1) if chroma == 0 or separate else ((1 if chroma == 3 else 2), (2 if chroma == 1 else 1))
        width -= step_x * (left + right)
        height -= step_y * (2 - frames_only) * (top + bottom)
    return width, height


def _skip_scaling(bits: _Bits, count: int) -> None:
    last, following = 8, 8
    for _ in range(count):
        if following:
            code = bits.golomb()
            following = (last + (-(code // 2) if code % 2 == 0 else (code + 1) // 2)) % 256
        last = following or last


def _h265(bits: _Bits) -> tuple[int, int]:
    bits.take(4)
    layers = bits.take(3)
    bits.take(1 + 88 + 8)
    present = [(bits.take(1), bits.take(1)) for _ in range(layers)]
    if layers:
        bits.take(2 * (8 - layers))
    for profile, level in present:
        bits.take(88 * profile + 8 * level)
    bits.golomb()
    chroma = bits.golomb()
    if chroma == 3:
        bits.take(1)
    width, height = bits.golomb(), bits.golomb()
    if bits.take(1):
        left, right, top, bottom = (bits.golomb() for _ in range(4))
        width -= (2 if chroma in (1, 2) else 1) * (left + right)
        height -= (2 if chroma == 1 else 1) * (top + bottom)
    return width, height


def _mpeg4(bits: _Bits) -> tuple[int, int] | None:
    bits.take(9)
    if bits.take(1):
        bits.take(7)
    if bits.take(4) == 15:
        bits.take(16)
    if bits.take(1):
        bits.take(3)
        if bits.take(1):
            bits.take(79)
    if bits.take(2) != 0:
        return None  # a shape of its own
    bits.take(1)
    ticks = bits.take(16)
    bits.take(1)
    if bits.take(1):
        bits.take(max(1, (ticks - 1).bit_length()))
    bits.take(1)
    width = bits.take(13)
    bits.take(1)
    return width, bits.take(13)


def _vp9(bits: _Bits) -> tuple[int, int] | None:
    if bits.take(2) != 2:
        return None
    profile = bits.take(1) + 2 * bits.take(1)
    if profile == 3:
        bits.take(1)
    if bits.take(1) or bits.take(1):
        return None  # shows an earlier frame, or is no key frame
    bits.take(2)
    if bits.take(24) != 0x498342:
        return None
    if profile >= 2:
        bits.take(1)
    if bits.take(3) != 7:
        bits.take(1)
        if profile in (1, 3):
            bits.take(3)
    elif profile in (1, 3):
        bits.take(1)
    return bits.take(16) + 1, bits.take(16) + 1


def _jpeg(packet: bytes) -> tuple[int, int] | None:
    place = 2
    while packet[place] == 0xFF:
        kind, length = packet[place + 1], int.from_bytes(packet[place + 2 : place + 4], "big")
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(packet[place + 7 : place + 9], "big"), int.from_bytes(
                packet[place + 5 : place + 7], "big"
            )
        if length < 2:
            return None
        place += 2 + length
    return None
