"""Readers of images and videos take files whose parts disagree as they take good ones: pixels, or an error of ours."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from built_files import check_built

from torchface.io.images.image_files import load_paint
from torchface.io.video import open_video

CASES = int(os.environ.get("TORCHFACE_FUZZ_CASES", "20"))


def read_image(path: Path) -> None:
    paint = load_paint(path)
    assert paint.shape[0] == 4
    assert 0 <= float(paint.min()) <= float(paint.max()) <= 1


def read_video(path: Path) -> None:
    video = open_video(path)
    for chunk in video.chunks(8):
        assert chunk.dtype == torch.uint8
        assert chunk.shape[1:] == (video.height, video.width)


@pytest.mark.parametrize(("reader", "strategy"), [(read_image, "picture_files"), (read_video, "video_files")])
def test_a_built_picture_is_read_or_refused(reader: Callable[[Path], None], strategy: str) -> None:
    check_built(reader, "built_pictures", strategy, CASES)
