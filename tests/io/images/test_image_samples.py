"""An image takes at most 500 MB or 20 times its file, whatever its header, tags and chunks claim."""

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from image_bytes import PNG_START, jpeg_segment, png, png_chunk, png_header, tiff, webp, webp_canvas
from PIL import Image
from reader_budget import check_budget

from torchface.io.images.image_files import load_image, load_paint

TINY = np.arange(27, dtype=np.uint8).reshape(3, 3, 3)


def black_png(width: int, height: int, bits: int, color: int, samples: int) -> bytes:
    """Black packs a thousand times."""
    packer, rows = zlib.compressobj(1), bytes(1 + width * samples * bits // 8)
    pixels = b"".join(packer.compress(rows * 64) for _ in range(height // 64)) + packer.flush()
    return PNG_START + png_header(width, height, bits, color) + png_chunk(b"IDAT", pixels) + png_chunk(b"IEND", b"")


def claims(width: int, height: int) -> dict[str, bytes]:
    """Small files of each kind that claim to be of this size."""
    size = struct.pack(">BHHB", 8, height, width, 3) + b"\1\x11\0\2\x11\0\3\x11\0"
    bitmap = struct.pack("<2sIHHI", b"BM", 54, 0, 0, 54) + struct.pack(
        "<IiiHHIIiiII", 40, width, height, 1, 24, *[0] * 6
    )
    large = tiff(TINY, 2).replace(struct.pack("<HHII", 256, 4, 1, 3), struct.pack("<HHII", 256, 4, 1, width))
    return {
        "png": PNG_START + png_header(width, height, 8, 2) + png_chunk(b"IDAT", b""),
        "jpg": b"\xff\xd8" + jpeg_segment(0xC0, size) + jpeg_segment(0xDA, bytes(10)),
        "webp": webp([(b"VP8X", webp_canvas(width, height, 0)), (b"VP8L", b"\x2f" + bytes(9))]),
        "tif": large.replace(struct.pack("<HHII", 257, 4, 1, 3), struct.pack("<HHII", 257, 4, 1, height)),
        "bmp": bitmap + bytes(64),
        "tga": struct.pack("<BBBHHBHHHHBB", 0, 0, 10, 0, 0, 0, 0, 0, width, height, 24, 0) + bytes(64),
        "ppm": b"P6 %d %d 255\n" % (width, height) + bytes(64),
    }


def crowded_directory(at: int, size: int) -> bytes:
    """As many tags as a directory holds, each of which points at the whole file."""
    rows = b"".join(struct.pack("<HHII", 1 + number, 1, size, 0) for number in range(65534))
    return struct.pack("<H", 65534) + rows + b"\0\0\0\0"


@pytest.mark.parametrize("kind", ["png", "jpg", "webp", "tif", "bmp", "tga", "ppm"])
def test_a_size_is_refused_before_pixels_are_decoded(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"bomb.{kind}"
    path.write_bytes(claims(13000, 12000)[kind])
    cost = check_budget(load_image, path)
    assert "found an image of 13000 x 12000 pixels in" in cost.refused
    assert cost.megabytes < 20


def test_the_largest_that_is_read_stays_within_the_budget(tmp_path: Path) -> None:
    (tmp_path / "black.png").write_bytes(black_png(4096, 4096, 8, 6, 4))
    cost = check_budget(load_paint, tmp_path / "black.png")
    assert cost.refused == ""
    assert cost.megabytes > 16 * 16  # four planes of floats: it was decoded


def test_tags_may_not_claim_more_than_there_is(tmp_path: Path) -> None:
    path = tmp_path / "crowded.tif"
    path.write_bytes(b"II*\0\x08\0\0\0" + crowded_directory(8, 750_000))
    assert "tags that claim more than" in check_budget(load_image, path).refused


def test_metadata_is_not_unpacked(tmp_path: Path) -> None:
    """EXIF of 750 kB whose tags claim 50 GB, text that unpacks to 50 MB a chunk, a TIFF that points at such EXIF."""
    crowded = b"II*\0\x08\0\0\0" + crowded_directory(8, 750_000)
    text = (b"zTXt", b"a\0\0" + zlib.compress(bytes(5 * 10**7)))
    (tmp_path / "a.png").write_bytes(png(TINY, 8, 2, before=[text] * 5, after=[(b"eXIf", crowded)]))
    parts = [crowded[at : at + 60_000] for at in range(0, len(crowded), 60_000)]
    buffer = io.BytesIO()
    Image.fromarray(TINY).save(buffer, "JPEG")
    segments = b"".join(jpeg_segment(0xE1, b"Exif\0\0" + part) for part in parts)
    (tmp_path / "a.jpg").write_bytes(buffer.getvalue()[:2] + segments + buffer.getvalue()[2:])
    whole = tiff(TINY, 2, tags=[(274, 3, [6]), (34665, 4, [10_000])])
    (tmp_path / "a.tif").write_bytes(whole.ljust(10_000, b"\0") + crowded_directory(10_000, 750_000))
    for name in ("a.png", "a.jpg", "a.tif"):
        cost = check_budget(load_image, tmp_path / name)
        assert cost.refused == ""
        assert cost.megabytes < 20


def test_a_tile_may_not_be_larger_than_images_are(tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(tiff(TINY, 2, tags=[(322, 4, [30_000]), (323, 4, [30_000])]))
    assert "found an image of 3 x 3 pixels" in check_budget(load_image, tmp_path / "a.tif").refused


def test_a_photograph_of_thousands_of_scans_is_refused(tmp_path: Path) -> None:
    """Each costs a pass over all pixels: 16 million in 20 bytes."""
    buffer = io.BytesIO()
    Image.fromarray(TINY).save(buffer, "JPEG", progressive=True)
    data = buffer.getvalue()
    scan = jpeg_segment(0xDA, b"\1\1\0\1\x3f\0")
    (tmp_path / "a.jpg").write_bytes(data[:-2] + scan * 200 + data[-2:])
    assert "scans, expected at most 100" in check_budget(load_image, tmp_path / "a.jpg").refused


def test_a_photograph_of_a_large_camera_is_read(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (600, 900, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "a.jpg"), np.tile(noise, (8, 8, 1)), [cv2.IMWRITE_JPEG_QUALITY, 20])
    assert (tmp_path / "a.jpg").stat().st_size < 4800 * 7200 / 2
    assert load_image(tmp_path / "a.jpg").shape == (3, 4800, 7200)
