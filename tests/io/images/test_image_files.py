import io
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mutation import check_reader
from PIL import Image

from torchface.errors import FileFormatError, ShapeError
from torchface.io import load_image, save_image, save_image16


@given(height=st.integers(1, 9), width=st.integers(1, 9), seed=st.integers(0, 99))
def test_a_picture_comes_back_to_half_a_step(
    height: int, width: int, seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "a.png"
    image = torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))
    save_image(image, path)
    found = load_image(path)
    assert found.shape == image.shape
    assert found.is_contiguous()
    assert (found - image).abs().max() <= 0.5 / 255 + 1e-6


def test_the_first_row_is_on_top_and_the_first_channel_red(tmp_path: Path) -> None:
    array = np.zeros((2, 3, 3), np.uint8)
    array[0, 2] = [255, 0, 0]
    Image.fromarray(array).save(tmp_path / "a.png")
    found = load_image(tmp_path / "a.png")
    assert found.nonzero().tolist() == [[0, 0, 2]]


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_every_png_of_sixteen_bits_keeps_them(channels: int, tmp_path: Path) -> None:
    steps = np.random.default_rng(0).integers(0, 65536, (5, 7, channels), dtype=np.uint16)
    path = tmp_path / "a.png"
    path.write_bytes(cv2.imencode(".png", steps)[1].tobytes())
    expected = steps[..., :3][..., ::-1] if channels > 1 else steps.repeat(3, 2)
    found = (65535 * load_image(path).double()).round().permute(1, 2, 0).numpy()
    assert np.array_equal(found, expected)


def test_a_bomb_of_sixteen_bits_is_refused_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(cv2.imencode(".png", np.zeros((5000, 5000), np.uint16))[1].tobytes())
    with pytest.raises(FileFormatError, match="found an image of 5000 x 5000 pixels"):
        load_image(path)
    save_image16(torch.rand(3, 40, 40), path)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(FileFormatError, match="found a broken PNG"):
        load_image(path)


def test_a_small_file_of_many_pixels_is_refused(tmp_path: Path) -> None:
    """Black packs a thousand times: 5000 x 5000 pixels in some 25 kilobytes."""
    Image.new("L", (5000, 5000)).save(tmp_path / "bomb.png", optimize=True)
    size = (tmp_path / "bomb.png").stat().st_size
    assert size < 200_000
    with pytest.raises(FileFormatError, match=rf"bomb.png: found an image of 5000 x 5000 pixels in {size} bytes"):
        load_image(tmp_path / "bomb.png")


def test_what_is_no_picture_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"not a picture at all")
    with pytest.raises(FileFormatError, match=r"a.png: no readable image"):
        load_image(tmp_path / "a.png")
    with pytest.raises(FileFormatError, match=r"none.png: found no such file"):
        load_image(tmp_path / "none.png")
    with pytest.raises(ShapeError, match=r"image: found \(5, 2, 2\), expected \(3,H,W\) or \(4,H,W\)"):
        save_image(torch.zeros(5, 2, 2), tmp_path / "b.png")
    assert not (tmp_path / "b.png").exists()


def test_a_mutated_picture_is_read_or_refused(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    seeds = []
    for kind, options in (
        ("PNG", {}),
        ("JPEG", {"quality": 80}),
        ("WEBP", {}),
        ("BMP", {}),
        ("TIFF", {}),
        ("TGA", {}),
        ("PPM", {}),
    ):
        buffer = io.BytesIO()
        Image.fromarray(noise).save(buffer, kind, **options)
        seeds.append(tmp_path / f"good.{kind.lower()}")
        seeds[-1].write_bytes(buffer.getvalue())
    report = check_reader(load_image, seeds, ".png")
    assert report.read > 0
    assert report.refused > 0
