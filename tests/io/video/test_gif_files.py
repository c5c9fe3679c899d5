"""Animated GIFs come as whole frames, as another reader composes them; damaged and oversized ones are refused."""

import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from mutation import check_reader
from PIL import Image
from video_samples import pattern

from torchface.errors import FileFormatError
from torchface.io.video import open_video

COUNT, WIDTH, HEIGHT = 6, 64, 48


@pytest.fixture(scope="module")
def animation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bar that moves, 12 times a second; each frame but the first holds what changes alone."""
    pictures = []
    for i in range(COUNT):
        picture = Image.fromarray(pattern(0, WIDTH, HEIGHT))
        picture.paste((250, 20 * i, 0), (5 * i, 10, 5 * i + 12, 30))
        pictures.append(picture.quantize(64))
    path = tmp_path_factory.mktemp("gif") / "bar.gif"
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=[80, 90, 80, 80, 90, 80], loop=0)
    return path


def read_whole(path: Path) -> None:
    for chunk in open_video(path).chunks():
        assert chunk.dtype == torch.uint8


def test_frames_are_whole_and_as_pillow_has_them(animation: Path) -> None:
    true, boxes = [], set()
    with Image.open(animation) as image:
        for i in range(COUNT):
            image.seek(i)
            boxes.add(image.dispose_extent if i == 0 else image.tile[0][1])
            true.append(np.asarray(image.convert("RGB")))
    assert len(boxes) > 1  # the file holds parts of frames
    video = open_video(animation)
    assert (video.width, video.height, video.count) == (WIDTH, HEIGHT, COUNT)
    assert video.fps == pytest.approx(12, rel=0.03)
    frames = torch.cat(list(video.color_chunks())).permute(0, 2, 3, 1).numpy()
    assert np.array_equal(frames, np.stack(true))


def test_a_mutated_gif_is_read_or_refused(animation: Path) -> None:
    report = check_reader(read_whole, [animation], ".gif")
    assert report.read > 0
    assert report.refused > 0


def test_absurd_sizes_are_refused(animation: Path, tmp_path: Path) -> None:
    content, path = animation.read_bytes(), tmp_path / "large.gif"
    for width, height in ((10_000, HEIGHT), (0xFFFF, 0xFFFF)):
        path.write_bytes(content[:6] + struct.pack("<HH", width, height) + content[10:])
        with pytest.raises(FileFormatError, match=f"frames of {width} x {height} pixels|no frame can be decoded"):
            read_whole(path)
    path.write_bytes(content[:6])
    with pytest.raises(FileFormatError, match=r"large\.gif"):
        read_whole(path)
