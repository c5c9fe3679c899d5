"""Images in another colour space than sRGB are converted to it, by a profile or a PNG's exponent."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from image_bytes import png_chunk
from PIL import Image, ImageCms

from torchface.color_space import to_srgb
from torchface.io import load_image
from torchface.io.images.image_files import decode_image, load_paint

# sRGB's red, green and blue as profiles have them (adapted to D50).
PRIMARIES = ((0.43607, 0.22250, 0.01393), (0.38506, 0.71688, 0.09710), (0.14308, 0.06062, 0.71417))


def fixed(*numbers: float) -> bytes:
    return b"".join(struct.pack(">i", round(65536 * number)) for number in numbers)


def profile(primaries: tuple[tuple[float, ...], ...], exponent: float) -> bytes:
    """A profile of three primaries and one curve. Source: ICC.1:2001-04, 6 and 8.3."""
    curve = b"curv" + bytes(4) + struct.pack(">IHH", 1, round(256 * exponent), 0)
    tags = {b"wtpt": b"XYZ " + bytes(4) + fixed(0.9642, 1, 0.8249)}
    for letter, primary in zip(b"rgb", primaries, strict=True):
        tags[bytes([letter]) + b"XYZ"] = b"XYZ " + bytes(4) + fixed(*primary)
        tags[bytes([letter]) + b"TRC"] = curve
    table, body, at = b"", b"", 132 + 12 * len(tags)
    for name, content in tags.items():
        table += name + struct.pack(">II", at + len(body), len(content))
        body += content
    head = struct.pack(">I", at + len(body)) + bytes(4) + bytes([2, 16, 0, 0]) + b"mntrRGB XYZ "
    head += bytes(12) + b"acsp" + bytes(28) + fixed(0.9642, 1, 0.8249)
    return head + bytes(128 - len(head)) + struct.pack(">I", len(tags)) + table + body


@pytest.fixture
def colors() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (300, 4, 3), np.uint8)


@pytest.mark.parametrize("ending", ["png", "tif", "webp", "jpg"])
def test_a_profile_of_light_with_two_primaries_swapped(ending: str, colors: np.ndarray, tmp_path: Path) -> None:
    red, green, blue = PRIMARIES
    if ending == "jpg":
        colors[:] = colors[:1, :1]  # which it keeps
    path = tmp_path / f"image.{ending}"
    Image.fromarray(colors).save(path, icc_profile=profile((green, red, blue), 1.0), lossless=True, quality=100)
    with Image.open(path) as image:
        stored = torch.from_numpy(np.asarray(image) / 255).permute(2, 0, 1)
    torch.testing.assert_close(load_image(path).double(), to_srgb(stored)[[1, 0, 2]], atol=0.011, rtol=0)
    torch.testing.assert_close(decode_image(path.read_bytes(), "texture").double(), stored, atol=1e-6, rtol=0)


@pytest.mark.parametrize("first", ["none", "sRGB"])
@pytest.mark.parametrize("where", ["behind", "thumbnail"])
def test_a_second_picture_in_a_jpeg_gives_it_no_profile(first: str, where: str, tmp_path: Path) -> None:
    red, green, blue = PRIMARIES
    flat = Image.new("RGB", (16, 16), (200, 90, 30))
    own = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes() if first == "sRGB" else None
    flat.save(tmp_path / "image.jpg", icc_profile=own)
    flat.save(tmp_path / "other.jpg", icc_profile=profile((blue, green, red), 2.2))
    alone, swapped = load_image(tmp_path / "image.jpg"), load_image(tmp_path / "other.jpg")
    torch.testing.assert_close(swapped, alone[[2, 1, 0]], atol=0.03, rtol=0)
    data, other = (tmp_path / "image.jpg").read_bytes(), (tmp_path / "other.jpg").read_bytes()
    segment = b"\xff\xff\xe1" + struct.pack(">H", 2 + len(other)) + other  # an 0xFF more may stand before a marker
    both = data + other if where == "behind" else data[:2] + segment + data[2:]
    (tmp_path / "image.jpg").write_bytes(both)
    assert torch.equal(load_image(tmp_path / "image.jpg"), alone)


def test_what_says_that_it_is_srgb_is_not_changed(colors: np.ndarray, tmp_path: Path) -> None:
    own = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(colors).save(tmp_path / "image.png", icc_profile=own)
    Image.fromarray(colors).save(tmp_path / "plain.png")
    data = (tmp_path / "plain.png").read_bytes()
    (tmp_path / "gamma.png").write_bytes(data[:33] + png_chunk(b"gAMA", struct.pack(">I", 45455)) + data[33:])
    for name in ("image", "gamma"):
        assert torch.equal(load_image(tmp_path / f"{name}.png"), load_image(tmp_path / "plain.png"))


def test_a_png_of_light_by_its_exponent_keeps_its_opacity(colors: np.ndarray, tmp_path: Path) -> None:
    whole = np.dstack([colors, colors[..., :1]])
    Image.fromarray(whole).save(tmp_path / "image.png")
    data = (tmp_path / "image.png").read_bytes()
    (tmp_path / "image.png").write_bytes(data[:33] + png_chunk(b"gAMA", struct.pack(">I", 100_000)) + data[33:])
    stored = torch.from_numpy(whole / 255).permute(2, 0, 1)
    expected = torch.cat([to_srgb(stored[:3]), stored[3:]])
    torch.testing.assert_close(load_paint(tmp_path / "image.png").double(), expected, atol=0.003, rtol=0)


@pytest.mark.parametrize("broken", [b"no profile", profile(PRIMARIES, 1.0)[:200], b""])
def test_a_broken_profile_is_left_out_with_a_warning(broken: bytes, colors: np.ndarray, tmp_path: Path) -> None:
    Image.fromarray(colors).save(tmp_path / "image.png")
    data = (tmp_path / "image.png").read_bytes()
    packed = b"icc\0\0" + (zlib.compress(broken) if broken else b"junk")
    (tmp_path / "image.png").write_bytes(data[:33] + png_chunk(b"iCCP", packed) + data[33:])
    with pytest.warns(UserWarning, match=r"image\.png: its colour profile was left out"):
        found = load_image(tmp_path / "image.png")
    np.testing.assert_allclose(found.permute(1, 2, 0) * 255, colors, atol=1e-3)
