"""Headers of image files, read before a pixel is decoded: kind, size, samples and orientation."""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from torchface.errors import FileFormatError
from torchface.io.images import tiff_tags
from torchface.io.images.tiff_tags import exif_orientation, first_directory, plausible_orientation, without_metadata

KINDS = "PNG, JPEG, WebP, BMP, TGA, TIFF or PPM"
_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_OTHERS = (
    *((b"GIF8", "GIF"), (b"v/1\x01", "OpenEXR"), (b"#?R", "Radiance HDR"), (b"8BPS", "PSD"), (b"DDS ", "DDS")),
    *((b"\0\0\0\x0cjP  ", "JPEG 2000"), (b"\xff\x4f\xff\x51", "JPEG 2000"), (b"\xabKTX", "KTX")),
    *((b"\0\0\0\x0cJXL ", "JPEG XL"), (b"\xff\x0a", "JPEG XL"), (b"FUJIFILMCCD", "a camera's raw file")),
    *((b"%PDF", "PDF"), (b"<svg", "SVG"), (b"<?xml", "XML")),
)
_HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
_PNG_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_PNG_PIXELS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
_JPEG_SIZES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_JPEG_LONE = {0x01, *range(0xD0, 0xD9)}
_JPEG_KEPT = (0xE0, 0xEE)  # JFIF and Adobe: what the colours are
_MOST_SCANS = 100
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")  # in the pixels: no stuffed byte, no restart
_RAW_COMPRESSION = 34713  # Nikon's
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB = 0, 1, 2
_UNSIGNED, _UNTOLD = 1, 4


@dataclass(frozen=True, eq=False)
class ImageHeader:
    """An image as its file describes it."""

    kind: str
    # width, height: pixels, as they are stored
    width: int
    height: int
    samples: int  # of a pixel, such as 3
    bits: int  # of a sample
    number: int  # what a sample is: 1 an unsigned whole number, 2 a signed one, 3 floating point (TIFF's numbering)
    orientation: int  # EXIF's, 1 (upright) to 8
    data: bytes  # the file for a decoder: without what is no pixel, where such parts may claim gigabytes
    least_pixels: int = 0  # that a decoder unpacks at a time, such as those of a tile
    inverted: bool = False  # 0 is white
    # A PNG's one colour that is, in the samples that are decoded; empty where there is none.
    transparent: tuple[int, ...] = ()


def read_header(data: bytes, source: str) -> ImageHeader | None:
    """The header of a PNG, JPEG, WebP or TIFF; None for a file that may be BMP, TGA or PPM, whose own is plain."""
    try:
        if data.startswith(_PNG):
            return _png(data, source)
        if data.startswith(b"\xff\xd8\xff"):
            return _jpeg(data, source)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp(data, source)
        if data.startswith(_TIFF):
            return _tiff(data, source)
    except (struct.error, IndexError) as error:
        raise FileFormatError(f"{source}: no readable image: its header is cut off") from error
    other = _other_kind(data)
    if other:
        raise FileFormatError(
            f"{source}: no readable image: found {other}, which is not read; expected {KINDS}: save it as one of those"
        )
    return None


def _other_kind(data: bytes) -> str:
    if data[4:8] == b"ftyp":
        brand = data[8:12]
        return "HEIC" if brand in _HEIF_BRANDS else "AVIF" if brand[:3] == b"avi" else "a video"
    return next((name for start, name in _OTHERS if data.startswith(start)), "")


def _png(data: bytes, source: str) -> ImageHeader:
    """Text, profiles and later frames are left out: they may unpack to more than the pixels do."""
    width, height, bits, color = struct.unpack_from(">IIBB", data, 16)
    if data[12:16] != b"IHDR" or color not in _PNG_SAMPLES:
        raise FileFormatError(f"{source}: no readable image: found {data[12:16]!r} and colour type {color} in a PNG")
    chunks, exif, transparent = list[bytes | memoryview]([data[:8]]), b"", tuple[int, ...]()
    view, samples = memoryview(data), _PNG_SAMPLES[color]
    for kind, first, end in _png_chunks(data):
        if kind == b"tRNS" and color in (0, 2):  # which Pillow misses in grey of less than 8 bits, OpenCV in grey of 16
            highest = 2**bits - 1
            step = 255 // highest if bits in (1, 2, 4) else 1
            transparent = tuple(step * (c & highest) for c in struct.unpack_from(f">{samples}H", data, first + 8))
        elif kind in _PNG_PIXELS and (kind != b"IHDR" or len(chunks) == 1):  # the size that is checked, not a later one
            chunks.append(view[first:end])
        elif kind == b"eXIf":
            exif = data[first + 8 : end - 4]
    orientation, plain = exif_orientation(exif, source), b"".join(chunks)
    return ImageHeader("PNG", width, height, samples, bits, 1, orientation, plain, transparent=transparent)


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Name, start and end of each chunk; the last may be cut off."""
    at = 8
    while at + 8 <= len(data):  # chunks have to be walked one after the other
        (length,) = struct.unpack_from(">I", data, at)
        yield data[at + 4 : at + 8], at, min(at + 12 + length, len(data))
        at += 12 + length


def _jpeg(data: bytes, source: str) -> ImageHeader:
    """Metadata is left out; each of thousands of scans of a few bytes would cost a pass over all pixels."""
    segments, exif, size = list[bytes | memoryview]([data[:2]]), b"", b""
    at, view = 2, memoryview(data)
    while True:  # segments have to be walked one after the other
        at = data.find(b"\xff", at)
        while at >= 0 and data[at + 1] == 0xFF:
            at += 1
        if at < 0:
            raise FileFormatError(f"{source}: no readable image: found a JPEG without pixels")
        marker = data[at + 1]
        if marker in _JPEG_LONE or marker == 0:
            at += 2
            continue
        if marker in (0xDA, 0xD9):
            break
        end = at + 2 + struct.unpack_from(">H", data, at + 2)[0]
        if marker in _JPEG_SIZES:
            if size:
                raise FileFormatError(f"{source}: no readable image: found a JPEG with two sizes, expected one")
            size = data[at + 4 : end]
        if marker == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            exif = exif or data[at + 4 : end]
        if marker in _JPEG_KEPT or not 0xE0 <= marker <= 0xFE:
            segments.append(view[at:end])
        at = end
    bits, height, width, samples = struct.unpack_from(">BHHB", size)
    end, scans = at, 0
    # What follows the end is none of the image, such as a phone's video.
    while match := _JPEG_MARKER.search(data, end):
        end = match.end()
        if match[0] == b"\xff\xd9":
            break
        scans += match[0] == b"\xff\xda"
        end += int.from_bytes(data[end : end + 2], "big")
    else:
        end = len(data)
    if scans > _MOST_SCANS:
        raise FileFormatError(f"{source}: found a JPEG of {scans} scans, expected at most {_MOST_SCANS}")
    if bits != 8:
        raise FileFormatError(f"{source}: found a JPEG of {bits} bits a sample, expected 8; save it as TIFF or PNG")
    segments.append(view[at:end])
    return ImageHeader("JPEG", width, height, samples, bits, 1, exif_orientation(exif, source), b"".join(segments))


def _webp(data: bytes, source: str) -> ImageHeader:
    name, first = data[12:16], 20
    if name == b"VP8X":
        width, height = (1 + int.from_bytes(data[at : at + 3], "little") for at in (first + 4, first + 7))
    elif name == b"VP8L":
        (packed,) = struct.unpack_from("<I", data, first + 1)
        width, height = 1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF)
    elif name == b"VP8 ":
        width, height = (side & 0x3FFF for side in struct.unpack_from("<HH", data, first + 6))
    else:
        raise FileFormatError(f"{source}: no readable image: found the part {name!r} in a WebP, expected VP8")
    exif, at = b"", 12
    while at + 8 <= len(data):  # parts have to be walked one after the other
        (length,) = struct.unpack_from("<I", data, at + 4)
        if data[at : at + 4] == b"EXIF":
            exif = data[at + 8 : at + 8 + length]
            break
        at += 8 + length + length % 2
    return ImageHeader("WEBP", width, height, 4, 8, 1, exif_orientation(exif, source), data)


def _tiff(data: bytes, source: str) -> ImageHeader:
    tags = first_directory(data, source)
    compression = tags.get(tiff_tags.COMPRESSION, (1,))[0]
    is_raw = tiff_tags.DNG_VERSION in tags or compression == _RAW_COMPRESSION or data[8:10] == b"CR"
    if is_raw or tags.get(tiff_tags.SUBFILE, (0,))[0] & 1:
        raise FileFormatError(f"{source}: found a camera's raw file or a preview, expected {KINDS}: develop it first")
    width, height = tags.get(tiff_tags.WIDTH, (0,))[0], tags.get(tiff_tags.HEIGHT, (0,))[0]
    bits, numbers = {*tags.get(tiff_tags.BITS, (1,))}, {*tags.get(tiff_tags.SAMPLE_FORMAT, (1,))}
    samples, photometric = tags.get(tiff_tags.SAMPLES, (1,))[0], tags.get(tiff_tags.PHOTOMETRIC, (1,))[0]
    tile = tags.get(tiff_tags.TILE_WIDTH, (0,))[0] * tags.get(tiff_tags.TILE_HEIGHT, (0,))[0]
    if len(bits) > 1 or len(numbers) > 1 or not 1 <= samples <= 5:
        raise FileFormatError(
            f"{source}: found a TIFF of {samples} samples a pixel of {sorted(bits)} bits, expected up to 5 of one kind"
        )
    deep, number = max(bits) > 8, _UNSIGNED if max(numbers) == _UNTOLD else max(numbers)
    if (deep and photometric not in (_BLACK_IS_ZERO, _RGB, _WHITE_IS_ZERO)) or (not deep and number != _UNSIGNED):
        raise FileFormatError(
            f"{source}: found a TIFF of {max(bits)} bits a sample, sample format {number}, photometric interpretation "
            f"{photometric}; expected grey or RGB, or unsigned samples of 8 bits"
        )
    orientation, plain = plausible_orientation(tags), without_metadata(data, source)
    inverted = deep and photometric == _WHITE_IS_ZERO
    return ImageHeader("TIFF", width, height, samples, max(bits), number, orientation, plain, tile, inverted)
