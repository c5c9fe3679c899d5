"""Images and videos built by chance, of right chunks and boxes with odd sizes and counts: strategies of hypothesis.

Readers are driven by ``built_files.check_built(reader, "built_pictures", "picture_files", cases)``.
"""

import io
import struct
import zlib
from functools import cache
from typing import Any

import numpy as np
from hypothesis import strategies as st
from image_bytes import PNG_START, exif, jpeg_segment, png_chunk, riff_part, tiff_directory, webp, webp_canvas
from PIL import Image

_SIZES = (0, 1, 2, 3, 4, 7, 8, 16, 255, 4096, 4097, 16383, 65535)
_WORDS = (0, 1, 2, 8, 100, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1)
_KINDS = {1: 2**8, 3: 2**16, 4: 2**32, 16: 2**64}
_TAGS = (254, 256, 257, 258, 259, 262, 266, 273, 274, 277, 278, 279, 284, 317, 320, 322, 323, 324, 325, 338, 339, 347,
         700, 34665, 34853, 50706)  # fmt: skip
_COMPRESSIONS = (1, 2, 3, 4, 5, 6, 7, 8, 32773, 32946, 34712, 34713, 34925, 50000, 50001)
_JPEG_SIZE = 16
_PNG_KINDS = ((0, 1), (0, 2), (0, 4), (0, 8), (0, 16), (2, 8), (2, 16), (3, 1), (3, 2), (3, 4), (3, 8), (4, 8), (4, 16),
              (6, 8), (6, 16), (7, 3), (2, 32))  # fmt: skip
Draw = Any


def seldom(draw: Draw, odd: tuple[int, ...], usual: int, one_in: int = 12) -> int:
    """Mostly the usual number, once in so many times an odd one."""
    return draw(st.sampled_from(odd)) if draw(st.integers(1, one_in)) == one_in else usual


def picture_files() -> st.SearchStrategy[dict[str, bytes]]:
    """An image of any kind that is read."""
    kinds = st.one_of(_png_files(), _tiff_files(), _jpeg_files(), _webp_files(), _plain_files())
    return kinds.map(lambda data: {"case.png": data})


def video_files() -> st.SearchStrategy[dict[str, bytes]]:
    """An AVI or MOV of some frames."""
    return st.one_of(_avi_files(), _mov_files()).map(lambda data: {"case.avi": data})


@st.composite
def _exif_blocks(draw: Draw) -> bytes:
    block = exif(draw(st.integers(0, 9)), draw(st.sampled_from("<>")))
    if draw(st.booleans()):
        return block
    count, at = draw(st.sampled_from((0, 1, 500, 5000, 65535))), draw(st.sampled_from((0, 8, 2**31)))
    rows = struct.pack("<HHII", 274, 3, draw(st.sampled_from(_WORDS)), at) * min(count, 5000)
    return b"II*\0\x08\0\0\0" + struct.pack("<H", count) + rows


@st.composite
def _png_files(draw: Draw) -> bytes:
    width, height = (seldom(draw, _SIZES, draw(st.integers(1, 9))) for _ in range(2))
    color, bits = draw(st.sampled_from(_PNG_KINDS))
    interlaced = seldom(draw, (1, 2), 0)
    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, interlaced)
    row = 1 + (min(width, 99) * bits * {2: 3, 4: 2, 6: 4}.get(color, 1) + 7) // 8
    pixels = zlib.compress(
        draw(st.binary(max_size=64)).ljust(seldom(draw, (0, 1, 10**6), row * min(height, 99)), b"\0")
    )
    parts = [
        (b"PLTE", bytes(3 * seldom(draw, (0, 1, 3, 300), min(2**bits, 256)))),
        (b"tRNS", bytes(draw(st.sampled_from((0, 1, 2, 6, 256, 300))))),
        (b"eXIf", draw(_exif_blocks())),
        (b"zTXt", b"a\0\0" + zlib.compress(bytes(10**6))),
        (b"iCCP", b"a\0\0" + zlib.compress(bytes(10**6))),
        (b"acTL", struct.pack(">II", draw(st.sampled_from(_WORDS)), 0)),
        (b"fcTL", struct.pack(">IIIIIHHBB", 0, 9999, 9999, 0, 0, 1, 1, 0, 0)),
        (b"IHDR", struct.pack(">IIBBBBB", 30000, 30000, 8, 2, 0, 0, 0)),
        (b"IDAT", pixels[: len(pixels) // 2]),
    ]
    chosen = draw(st.lists(st.sampled_from(parts), max_size=4))
    late = draw(st.lists(st.sampled_from(parts), max_size=2))
    palette = parts[:1] if color == 3 else []
    body = [(b"IHDR", header), *palette, *chosen, (b"IDAT", pixels), *late, (b"IEND", b"")]
    data = PNG_START + b"".join(png_chunk(*part) for part in body)
    return data[: seldom(draw, (20, 33, 60), len(data))]


@st.composite
def _tiff_files(draw: Draw) -> bytes:
    order = draw(st.sampled_from("<>"))
    width, height = (seldom(draw, _SIZES, draw(st.integers(1, 9))) for _ in range(2))
    count, bits = draw(st.sampled_from((1, 3, 4, 2, 5, 9))), draw(st.sampled_from((1, 4, 8, 8, 16, 16, 32, 64, 12)))
    size = min(width, 99) * min(height, 99) * count * bits // 8
    plain = draw(st.binary(max_size=64)).ljust(size, b"\0")
    compression = seldom(draw, _COMPRESSIONS, 1, 2)
    pixels = zlib.compress(plain) if compression in (8, 32946) else plain
    tags = {
        256: (4, [width]), 257: (4, [height]), 258: (3, [bits] * count), 259: (3, [compression]),
        262: (3, [seldom(draw, (0, 1, 2, 3, 5, 6, 8), 2 if count > 2 else 1, 4)]), 273: (4, [seldom(draw, _WORDS, 8)]),
        277: (3, [seldom(draw, _SIZES, count)]), 278: (4, [seldom(draw, _WORDS, max(height, 1))]),
        279: (4, [seldom(draw, _WORDS, len(pixels))]),
        339: (3, [seldom(draw, (1, 2, 3, 4, 6), 3 if bits > 16 else 1, 4)] * count),
        317: (3, [seldom(draw, (2, 3), 1)]),
    }  # fmt: skip
    for number in draw(st.lists(st.sampled_from(_TAGS), max_size=2)):  # odd tags beside, or in place of good ones
        kind = draw(st.sampled_from((1, 3, 4)))
        value = draw(st.sampled_from((*_WORDS, 8))) % _KINDS[kind]
        tags[number] = (kind, [value] * draw(st.sampled_from((1, 1, 1, 2, 17, 3000))))
    at = 8 + len(pixels)
    rows = [(number, *tag) for number, tag in (sorted(tags.items()) if draw(st.booleans()) else list(tags.items()))]
    following = draw(st.sampled_from((0, 0, at, 8, 2**32 - 1)))  # a directory may lead back to itself
    start = struct.pack(f"{order}2sHI", b"II" if order == "<" else b"MM", 42, seldom(draw, _WORDS, at))
    return start + pixels + tiff_directory(rows, at, order, following)


@cache
def photograph(progressive: bool, mode: str) -> bytes:
    """A small JPEG."""
    noise = np.random.default_rng(0).integers(0, 255, (_JPEG_SIZE, _JPEG_SIZE, 3), dtype=np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noise).convert(mode).save(buffer, "JPEG", progressive=progressive)
    return buffer.getvalue()


@st.composite
def _jpeg_files(draw: Draw) -> bytes:
    data = photograph(draw(st.booleans()), draw(st.sampled_from(("RGB", "L", "CMYK"))))
    at, segments = 2, []
    while data[at + 1] != 0xDA:
        end = at + 2 + struct.unpack_from(">H", data, at + 2)[0]
        marker, content = data[at + 1], data[at + 4 : end]
        if marker in (0xC0, 0xC2):
            sides = [seldom(draw, _SIZES, _JPEG_SIZE) for _ in range(2)]
            factors = bytes([seldom(draw, (0, 0x14, 0x41, 0x44, 0xFF), content[7])])
            content = struct.pack(">BHH", seldom(draw, (2, 12), 8), *sides) + content[5:7] + factors + content[8:]
            marker = seldom(draw, (0xC1, 0xC3, 0xC9, 0xCA), marker)
        segments.append(jpeg_segment(marker, content))
        at = end
    for _ in range(draw(st.integers(0, 2))):
        beside = [(0xE1, b"Exif\0\0" + draw(_exif_blocks())[:65000]), (0xE2, b"MPF\0" + bytes(90)), (0xDD, b"\0\1")]
        beside += [(0xFE, b"text"), (0xE0, b"JFIF\0\1\1\0\0\0\0\0\0")]
        segments.insert(draw(st.integers(0, len(segments))), jpeg_segment(*draw(st.sampled_from(beside))))
    if draw(st.integers(1, 6)) == 6:
        segments = draw(st.permutations(segments))
    scans = data[at:-2] * draw(st.sampled_from((1, 1, 1, 2, 90)))
    return data[:2] + b"".join(segments) + scans + draw(st.sampled_from((b"\xff\xd9", b"", b"\xff\xda", data)))


@st.composite
def _webp_files(draw: Draw) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGBA", (9, 7), (1, 2, 3, 4)).save(buffer, "WEBP", lossless=True)
    pixels = buffer.getvalue()[20:]
    canvas = webp_canvas(seldom(draw, (1, 16384, 2**24), 9, 4), seldom(draw, (1, 16384, 2**24), 7, 4),
                         draw(st.sampled_from((0, 0x08, 0x10, 0x1A, 0x02, 0xFF))))  # fmt: skip
    frame = bytes(6) + webp_canvas(9, 7, 0)[4:] + bytes(4) + riff_part(b"VP8L", pixels)
    parts = [(b"VP8L", pixels), (b"EXIF", draw(_exif_blocks())), (b"ANIM", bytes(6)), (b"ANMF", frame),
             (b"ICCP", bytes(99)), (b"ALPH", bytes(9))]  # fmt: skip
    return webp([(b"VP8X", canvas), *draw(st.lists(st.sampled_from(parts), min_size=1, max_size=5))])


@st.composite
def _plain_files(draw: Draw) -> bytes:
    width, height = (seldom(draw, _SIZES, draw(st.integers(1, 9)), 6) for _ in range(2))
    pixels = draw(st.binary(max_size=300)).ljust(300, b"\0")
    kind = draw(st.sampled_from(("ppm", "bmp", "tga")))
    if kind == "ppm":
        letter, most = draw(st.sampled_from("123456fF")), draw(st.sampled_from(("255", "65535", "1", "0", "-1.0")))
        return f"P{letter}\n{width} {height}\n{most}\n".encode() + pixels
    if kind == "bmp":
        bits, packing = draw(st.sampled_from((1, 4, 8, 16, 24, 32, 7))), draw(st.sampled_from((0, 0, 1, 2, 3, 4)))
        colors = seldom(draw, _WORDS, 0)
        info = struct.pack("<IiiHHIIiiII", 40, width, height * draw(st.sampled_from((1, -1))), 1, bits, packing, 0, 0,
                           0, colors, 0)  # fmt: skip
        return struct.pack("<2sIHHI", b"BM", 354, 0, 0, seldom(draw, _WORDS, 54)) + info + pixels
    mapped, image = draw(st.sampled_from((0, 1))), draw(st.sampled_from((1, 2, 3, 9, 10, 11)))
    fields = (
        0,
        mapped,
        image,
        0,
        mapped * 256,
        24 * mapped,
        0,
        0,
        width,
        height,
        draw(st.sampled_from((8, 16, 24, 32))),
    )
    return struct.pack("<BBBHHBHHHHBB", *fields, draw(st.integers(0, 63))) + pixels


@st.composite
def _avi_files(draw: Draw) -> bytes:
    width, height = (seldom(draw, _SIZES, _JPEG_SIZE) for _ in range(2))
    codec, bits = draw(st.sampled_from(((b"MJPG", 24), (b"DIB ", 24), (b"FFV1", 24), (b"HFYU", 32), (b"\0\0\0\0", 8))))
    frame = photograph(False, "RGB") if codec == b"MJPG" else bytes(_JPEG_SIZE**2 * bits // 8)
    count = draw(st.integers(1, 4))
    times = [seldom(draw, _WORDS, number, 8) for number in (1, 25)]
    header = struct.pack("<14I", *(seldom(draw, _WORDS, number, 30) for number in
                                   (40000, 0, 0, 16, count, 0, 1, 0, width, height, 0, 0, 0, 0)))  # fmt: skip
    stream = b"vids" + codec + struct.pack("<IHHIIIIIIIIHHHH", 0, 0, 0, 0, *times, 0, seldom(draw, _WORDS, count), 0, 0,
                                           0, 0, 0, 0, 0)  # fmt: skip
    form = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, bits, codec, 0, 0, 0, seldom(draw, _WORDS, 0), 0)
    one = riff_part(b"LIST", b"strl" + riff_part(b"strh", stream) + riff_part(b"strf", form))
    streams = one * draw(st.sampled_from((1, 1, 1, 2, 60)))
    frames = b"".join(riff_part(b"00dc", frame[: seldom(draw, (0, 1, 9), len(frame))]) for _ in range(count))
    rows = b"".join(b"00dc" + struct.pack("<III", 16, seldom(draw, _WORDS, 4), len(frame)) for _ in range(count))
    movie = riff_part(b"LIST", b"movi" + frames) + (riff_part(b"idx1", rows) if draw(st.booleans()) else b"")
    content = b"AVI " + riff_part(b"LIST", b"hdrl" + riff_part(b"avih", header) + streams) + movie
    return b"RIFF" + struct.pack("<I", seldom(draw, _WORDS, len(content))) + content


def _box(kind: bytes, content: bytes, size: int | None = None) -> bytes:
    return struct.pack(">I", (len(content) + 8 if size is None else size) % 2**32) + kind + content


@st.composite
def _mov_files(draw: Draw) -> bytes:
    count, frame = draw(st.integers(1, 4)), photograph(False, "RGB")
    width, height = (seldom(draw, _SIZES, _JPEG_SIZE) for _ in range(2))

    def table(kind: bytes, rows: int, *numbers: int) -> bytes:
        odd = [seldom(draw, _WORDS, number, 30) for number in numbers]
        return _box(kind, struct.pack(f">II{len(odd)}I", 0, seldom(draw, _WORDS, rows, 30), *odd))

    start = _box(b"ftyp", b"qt  \0\0\0\0qt  ")
    entry = (
        bytes(6) + b"\0\1" + bytes(16) + struct.pack(">HH", width, height) + bytes(14) + bytes(32) + b"\0\x18\xff\xff"
    )
    codec = draw(st.sampled_from((b"jpeg", b"jpeg", b"raw ", b"avc1")))
    tables = [
        _box(b"stsd", struct.pack(">II", 0, 1) + _box(codec, entry)),
        table(b"stts", 1, count, 512), table(b"stsc", 1, 1, count, 1),
        _box(b"stsz", struct.pack(">III", 0, seldom(draw, _WORDS, len(frame), 30), seldom(draw, _WORDS, count))),
        table(b"stco", 1, len(start) + 8), table(b"ctts", 1, count, 0), table(b"stss", 1, 1),
    ]  # fmt: skip
    kept = tables[:5] if draw(st.booleans()) else draw(st.lists(st.sampled_from(tables), max_size=9))
    media = _box(
        b"mdhd", struct.pack(">IIIIII", 0, 0, 0, seldom(draw, _WORDS, 12800), seldom(draw, _WORDS, 512 * count), 0)
    )
    media += _box(b"hdlr", b"\0\0\0\0mhlrvide" + bytes(13))
    media += _box(b"minf", _box(b"vmhd", bytes(12)) + _box(b"stbl", b"".join(kept)))
    matrix = struct.pack(
        ">9I", *(seldom(draw, _WORDS, number, 30) for number in (2**16, 0, 0, 0, 2**16, 0, 0, 0, 2**30))
    )
    track = _box(b"tkhd", struct.pack(">IIIIII", 3, 0, 0, 1, 0, 512 * count) + bytes(16) + matrix + bytes(8))
    edit = _box(b"edts", table(b"elst", 1, 512 * count, 0, 2**16)) if draw(st.booleans()) else b""
    movie = _box(b"mvhd", struct.pack(">IIIII", 0, 0, 0, seldom(draw, _WORDS, 1000), 40 * count) + bytes(80))
    tracks = _box(b"trak", track + edit + _box(b"mdia", media)) * draw(st.sampled_from((1, 1, 1, 2, 60)))
    data = _box(b"mdat", frame * count, draw(st.sampled_from((None, None, None, 0, 1, 7, 2**32 - 1))))
    return start + data + _box(b"moov", movie + tracks, draw(st.sampled_from((None, None, None, 0, 9))))
