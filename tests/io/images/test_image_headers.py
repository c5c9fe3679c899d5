"""Every kind of image comes with the values that were planted, by whichever door, and upright."""

import io
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from image_bytes import exif, jpeg_segment, png, png_chunk, tiff, webp, webp_canvas
from PIL import Image, ImageOps

from torchface.errors import FileFormatError
from torchface.io import load_image
from torchface.io.images.image_files import load_paint
from torchface.landmarks.images.appearance.annotated_frames import load_annotated_frames

HEIGHT, WIDTH = 6, 9
ROWS_AND_COLUMNS = {  # where a photograph's first stored row and column belong, EXIF 2.3, tag 0x0112
    1: ("top", "left"), 2: ("top", "right"), 3: ("bottom", "right"), 4: ("bottom", "left"),
    5: ("left", "top"), 6: ("right", "top"), 7: ("right", "bottom"), 8: ("left", "bottom"),
}  # fmt: skip


def planted(count: int, steps: int) -> np.ndarray:
    """Samples (H,W,C) below ``steps``, the extremes among them."""
    found = np.random.default_rng(count + steps).integers(0, steps, (HEIGHT, WIDTH, count))
    found[0, 0], found[-1, -1] = 0, steps - 1
    return found


def read(data: bytes, folder: Path, name: str = "a.png") -> np.ndarray:
    """What both doors give, which agree, (H,W,4) float64."""
    (folder / name).write_bytes(data)
    paint = load_paint(folder / name)
    assert paint.dtype == torch.float32
    assert paint.is_contiguous()
    assert torch.equal(load_image(folder / name), paint[:3])
    return paint.permute(1, 2, 0).double().numpy()


def expected(values: np.ndarray) -> np.ndarray:
    """Values (H,W,C) in [0,1] as red, green, blue and opacity."""
    count = values.shape[2]
    colors = values[..., :3] if count > 2 else values[..., [0, 0, 0]]
    return np.dstack([colors, values[..., -1:] if count in (2, 4) else np.ones(values.shape[:2])])


def stored_as(upright: np.ndarray, orientation: int) -> np.ndarray:
    """The rows and columns that a camera held in this way stores of an upright image."""
    row, column = ROWS_AND_COLUMNS[orientation]
    turned = upright if row in ("top", "bottom") else upright.swapaxes(0, 1)
    turned = turned[::-1] if row in ("bottom", "right") else turned
    return np.ascontiguousarray(turned[:, ::-1] if column in ("bottom", "right") else turned)


@pytest.mark.parametrize(
    ("color", "count", "bits"),
    [(0, 1, 1), (0, 1, 2), (0, 1, 4), (0, 1, 8), (0, 1, 16), (4, 2, 8), (4, 2, 16), (2, 3, 8), (2, 3, 16), (6, 4, 8),
     (6, 4, 16)],
)  # fmt: skip
def test_png_of_every_kind(color: int, count: int, bits: int, tmp_path: Path) -> None:
    samples = planted(count, 2**bits)
    found = read(png(samples, bits, color), tmp_path)
    assert np.abs(found - expected(samples / (2**bits - 1))).max() < 1e-7


@pytest.mark.parametrize(("color", "count", "bits"), [(0, 1, 4), (0, 1, 8), (0, 1, 16), (2, 3, 8), (2, 3, 16)])
def test_one_colour_of_a_png_may_be_transparent(color: int, count: int, bits: int, tmp_path: Path) -> None:
    samples = planted(count, 2**bits)
    key = samples[2, 3]
    found = read(png(samples, bits, color, [(b"tRNS", key.astype(">u2").tobytes())]), tmp_path)
    assert np.array_equal(found[..., 3] == 0, (samples == key).all(2))
    assert np.abs(found[..., :3] - expected(samples / (2**bits - 1))[..., :3]).max() < 1e-7


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
@pytest.mark.parametrize("transparent", [False, True])
def test_png_with_a_palette(bits: int, transparent: bool, tmp_path: Path) -> None:
    generator = np.random.default_rng(bits)
    palette = generator.integers(0, 256, (2**bits, 4), dtype=np.uint8)
    palette[2 ** (bits - 1) :, 3] = 255  # opacity may be given for the first ones alone
    chunks = [(b"PLTE", palette[:, :3].tobytes())]
    chunks += [(b"tRNS", palette[: 2 ** (bits - 1), 3].tobytes())] if transparent else []
    indices = planted(1, 2**bits)
    values = palette[indices[..., 0]] / 255
    wanted = values if transparent else expected(values[..., :3])
    assert np.abs(read(png(indices, bits, 3, chunks), tmp_path) - wanted).max() < 1e-7


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("count", [1, 3, 4])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32, np.float64])
def test_tiff_of_every_kind(kind: type, count: int, order: str, tmp_path: Path) -> None:
    floating = np.issubdtype(kind, np.floating)
    steps = 2**16 if floating else np.iinfo(kind).max + 1
    values = planted(count, steps) / (steps - 1)
    samples = values.astype(kind) if floating else planted(count, steps).astype(kind)
    data = tiff(samples, 1 if count == 1 else 2, 3 if floating else 1, order)
    assert np.abs(read(data, tmp_path, "a.tif") - expected(values)).max() < 1e-7


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_where_zero_is_white(kind: type, tmp_path: Path) -> None:
    most = np.iinfo(kind).max
    samples = planted(1, most + 1).astype(kind)
    found = read(tiff(samples, 0), tmp_path, "a.tif")
    assert np.abs(found - expected(1 - samples / most)).max() < 1e-7


def test_grey_maps_of_sixteen_bits_and_of_floats(tmp_path: Path) -> None:
    samples = planted(1, 4096)
    data = b"P5 %d %d 4095\n" % (WIDTH, HEIGHT) + samples.astype(">u2").tobytes()
    assert np.abs(read(data, tmp_path, "a.pgm") - expected(samples / 4095)).max() < 0.6 / 65535
    values = planted(1, 65536) / 65535
    data = b"Pf\n%d %d\n-1.0\n" % (WIDTH, HEIGHT) + values[::-1].astype("<f4").tobytes()  # its last row comes first
    assert np.abs(read(data, tmp_path, "a.pfm") - expected(values)).max() < 1e-7


def test_cmyk_is_as_opencv_decodes_it(tmp_path: Path) -> None:
    blocks = np.random.default_rng(0).integers(0, 256, (3, 4, 4), dtype=np.uint8).repeat(16, 0).repeat(16, 1)
    Image.fromarray(blocks, "CMYK").save(tmp_path / "a.jpg", quality=100, subsampling=0)
    found = 255 * load_image(tmp_path / "a.jpg").permute(1, 2, 0).numpy()
    other = cv2.imread(str(tmp_path / "a.jpg"))[..., ::-1].astype(float)
    assert np.abs(found - other).max() <= 2
    cyan, black = blocks[..., :1] / 255, blocks[..., 3:] / 255
    assert np.abs(found[..., :1] / 255 - (1 - cyan) * (1 - black)).max() < 0.03


def jpeg_file(image: np.ndarray, orientation: int) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=95, subsampling=0)
    data = buffer.getvalue()
    return data[:2] + jpeg_segment(0xE1, b"Exif\0\0" + exif(orientation, ">")) + data[2:]


def webp_file(image: np.ndarray, orientation: int) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "WEBP", lossless=True)
    data = buffer.getvalue()
    assert data[12:16] == b"VP8L"
    canvas = webp_canvas(image.shape[1], image.shape[0], 0x08)
    return webp([(b"VP8X", canvas), (b"VP8L", data[20:]), (b"EXIF", exif(orientation))])


def png_file(image: np.ndarray, orientation: int) -> bytes:
    return png(image, 8, 2, before=[(b"eXIf", exif(orientation, ">"))])


def png_with_late_exif(image: np.ndarray, orientation: int) -> bytes:
    return png(image, 8, 2, after=[(b"eXIf", exif(orientation))])


def deep_png_file(image: np.ndarray, orientation: int) -> bytes:
    return png(257 * image.astype(int), 16, 2, after=[(b"eXIf", exif(orientation))])


def tiff_file(image: np.ndarray, orientation: int) -> bytes:
    return tiff(image, 2, tags=[(274, 3, [orientation])])


def deep_tiff_file(image: np.ndarray, orientation: int) -> bytes:
    return tiff(257 * image.astype(np.uint16), 2, order=">", tags=[(274, 3, [orientation])])


def grey_float_tiff_file(image: np.ndarray, orientation: int) -> bytes:
    return tiff((image[..., :1] / 255).astype(np.float32), 1, 3, tags=[(274, 3, [orientation])])


PHOTOGRAPHS = [
    *(jpeg_file, webp_file, png_file, png_with_late_exif, deep_png_file, tiff_file, deep_tiff_file),
    grey_float_tiff_file,
]


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("write", PHOTOGRAPHS)
def test_photographs_come_upright(write: Callable[[np.ndarray, int], bytes], orientation: int, tmp_path: Path) -> None:
    y, x = np.mgrid[:16, :24]
    upright = np.dstack([10 * x, 15 * y, 120 + 3 * x - 4 * y]).astype(np.uint8)
    if write is grey_float_tiff_file:
        upright = upright[..., [0, 0, 0]] // 2 + upright[..., [1, 1, 1]] // 2
    found = 255 * read(write(stored_as(upright, orientation), orientation), tmp_path)[..., :3]
    assert found.shape == upright.shape
    assert np.abs(found - upright).max() < (8 if write is jpeg_file else 1e-4)


def test_turning_agrees_with_pillow_and_a_wrong_number_turns_nothing(tmp_path: Path) -> None:
    image = planted(3, 256).astype(np.uint8)
    for orientation in (0, 1, 2, 3, 4, 5, 6, 7, 8, 9):
        data = png_file(image, orientation)
        found = 255 * read(data, tmp_path)[..., :3]
        with Image.open(io.BytesIO(data)) as opened:
            other = np.asarray(ImageOps.exif_transpose(opened))
        assert np.array_equal(found.round(), other)
    damaged = png(image, 8, 2, before=[(b"eXIf", exif(6)[:13])])
    assert np.array_equal((255 * read(damaged, tmp_path)).round()[..., :3], image)


def test_landmarks_are_those_of_the_upright_photograph(tmp_path: Path) -> None:
    """A phone held upright stores its rows from the right: annotations count from the corner that viewers show."""
    upright = np.zeros((200, 120, 3), np.uint8)
    rows, columns = np.divmod(np.arange(68), 8)
    points = np.stack([10 + 12 * columns, 20 + 18 * rows], 1)
    upright[points[:, 1], points[:, 0]] = 255
    (tmp_path / "phone.png").write_bytes(png_file(stored_as(upright, 6), 6))
    text = "".join(f"{x + 1} {y + 1}\n" for x, y in points)
    (tmp_path / "phone.pts").write_text(f"version: 1\nn_points: 68\n{{\n{text}}}\n")
    (frame,) = load_annotated_frames(tmp_path)
    x, y = frame.landmarks.round().long().T
    assert frame.image.shape == (3, 200, 120)
    assert (frame.image[:, y, x] == 1).all()
    assert frame.image.sum() == 3 * 68


@pytest.mark.parametrize(
    ("start", "name"),
    [
        *((b"GIF89a", "GIF"), (b"v/1\x01\x02\0\0\0", "OpenEXR"), (b"#?RADIANCE\n", "Radiance HDR")),
        *((b"\0\0\0\x18ftypheic", "HEIC"), (b"\0\0\0\x1cftypavif", "AVIF"), (b"\0\0\0\x20ftypisom", "a video")),
        *((b"8BPS\0\x01", "PSD"), (b"\0\0\0\x0cjP  \r\n\x87\n", "JPEG 2000")),
    ],
)
def test_what_is_not_read_is_named(start: bytes, name: str, tmp_path: Path) -> None:
    (tmp_path / "face.png").write_bytes(start + bytes(64))
    with pytest.raises(FileFormatError, match=rf"face.png: no readable image: found {name}, .*expected PNG, JPEG, "):
        load_image(tmp_path / "face.png")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (tiff(np.full((2, 2, 1), 1.5, np.float32), 1, 3), "values from 1.5 to 1.5, expected 0 .black. to 1 .white."),
        (tiff(np.full((2, 2, 3), np.nan, np.float32), 2, 3), "values from nan to nan, expected 0"),
        (tiff(np.zeros((2, 2, 1), np.uint32), 1), "an unsigned whole number of 32 bits; expected up to 4"),
        (tiff(np.zeros((2, 2, 1), np.int16), 1, 2), "a signed whole number of 16 bits; expected up to 4"),
        (tiff(np.zeros((2, 2, 4), np.uint16), 5), "photometric interpretation 5; expected grey or RGB"),
        (tiff(np.zeros((2, 2, 2), np.uint16), 1), "a layout that is not read"),
        (tiff(np.zeros((2, 2, 3), np.uint8), 2, tags=[(254, 4, [1])]), "a camera's raw file or a preview"),
        (tiff(np.zeros((2, 2, 3), np.uint8), 2, tags=[(50706, 1, [1, 4, 0, 0])]), "a camera's raw file"),
        (b"\xff\xd8" + jpeg_segment(0xC1, b"\x0c\0\2\0\2\1\1\x11\0") + b"\xff\xda", "12 bits a sample, expected 8"),
    ],
)
def test_pixels_that_cannot_be_explained_are_refused(data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(data)
    with pytest.raises(FileFormatError, match=message):
        load_image(tmp_path / "a.tif")


def test_a_chunk_that_no_pixel_needs_changes_nothing(tmp_path: Path) -> None:
    image = planted(3, 256)
    data = png(image, 8, 2, before=[(b"gAMA", b"\0\0\0\1"), (b"tEXt", b"a\0b")], after=[(b"zTXt", b"a\0\0zz")])
    late_header = data[:33] + png_chunk(b"IHDR", b"\0\0\x20\0\0\0\x20\0\x08\x02\0\0\0") + data[33:]
    for one in (data, late_header):
        assert np.array_equal((255 * read(one, tmp_path)).round()[..., :3], image)


def test_what_follows_a_photograph_is_none_of_it(tmp_path: Path) -> None:
    """Phones put a short video behind a photograph; its bytes hold what looks like scans."""
    image = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)
    data = cv2.imencode(".jpg", image)[1].tobytes()
    (tmp_path / "alone.jpg").write_bytes(data)
    (tmp_path / "moving.jpg").write_bytes(data + b"\xff\xda\xff\xd9" * 500)
    assert torch.equal(load_image(tmp_path / "moving.jpg"), load_image(tmp_path / "alone.jpg"))
    (tmp_path / "many.jpg").write_bytes(data[:-2] + b"\xff\xda\x00\x02" * 101 + data[-2:])
    with pytest.raises(FileFormatError, match="a JPEG of 102 scans"):
        load_image(tmp_path / "many.jpg")
