"""Blur and heavy compression of a photograph are said with their measures; of sharp ones nothing is said."""

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from torchface.io import load_image, load_landmark_points
from torchface.workflows.fit.sharpness_checks import blockiness, resolved_points, sharpness_lines

SIZE, EYES = 240, 100.0
ALONG = {"both": (3.0, 3.0), "rows": (3.0, 1e-3), "columns": (1e-3, 3.0)}


@pytest.fixture
def marks() -> Tensor:
    """Landmarks on a circle, the outer corners of the eyes 100 pixels apart."""
    angles = torch.linspace(0, 2 * torch.pi, 69, dtype=torch.float64)[:68]
    points = SIZE / 2 + 90 * torch.stack([angles.cos(), angles.sin()], dim=1)
    points[36], points[45] = torch.tensor([70.0, 100.0]), torch.tensor([170.0, 100.0])
    return points


@pytest.fixture
def squares() -> Tensor:
    """Squares of two greys, (SIZE,SIZE)."""
    place = torch.arange(SIZE) // 37
    return 0.3 + 0.4 * ((place[:, None] + place) % 2)


@pytest.mark.parametrize("along", ALONG)
def test_points_are_the_eyes_distance_over_the_width_of_a_blurred_edge(
    marks: Tensor, squares: Tensor, along: str
) -> None:
    width, height = ALONG[along]
    blurred = torch.from_numpy(cv2.GaussianBlur(squares.numpy(), (0, 0), sigmaX=width, sigmaY=height))
    assert resolved_points(blurred, marks) == pytest.approx(EYES / (2.355 * 3.0), rel=0.1)
    twice = torch.nn.functional.interpolate(blurred[None, None], scale_factor=4, mode="bilinear")[0, 0]
    assert resolved_points(twice, 4 * marks + 1.5) == pytest.approx(EYES / (2.355 * 3.0), rel=0.15)


def test_blocks_show_wherever_their_grid_lies_and_grain_has_none(marks: Tensor) -> None:
    grain = cv2.GaussianBlur(np.random.default_rng(0).normal(0.5, 0.3, (SIZE, SIZE)).astype(np.float32), (0, 0), 3)
    file = io.BytesIO()
    Image.fromarray((255 * grain.clip(0, 1)).astype(np.uint8)).save(file, "jpeg", quality=4)
    coarse = torch.from_numpy(np.array(Image.open(file)).astype(np.float32) / 255)
    assert blockiness(torch.from_numpy(grain), marks) < 0.3
    for shift in (0, 3):
        moved = coarse.roll(shift, 1)
        assert blockiness(moved, marks) > 1.1
        assert "compressed" in "".join(sharpness_lines([Path("a.jpg")], [moved.expand(3, -1, -1)], marks[None]))


def test_without_the_eyes_corners_and_for_tiny_faces_nothing_is_said_of_blur(marks: Tensor, squares: Tensor) -> None:
    picture = torch.from_numpy(cv2.GaussianBlur(squares.numpy(), (0, 0), 9.0)).expand(3, -1, -1)
    assert len(sharpness_lines([Path("a.png")], [picture], marks[None])) == 1
    hidden = marks.clone()
    hidden[36] = torch.nan
    assert sharpness_lines([Path("a.png")], [picture], hidden[None]) == []
    assert sharpness_lines([Path("a.png")], [picture], 0.1 * marks[None]) == []


@pytest.mark.real
@pytest.mark.parametrize("name", ["lfpw_1.png", "lfpw_2.png", "takeo.ppm", "einstein.jpg"])
def test_photographs_are_sharp_until_they_are_blurred(data: Path, name: str) -> None:
    path = data / "images/people" / name
    image, marks = load_image(path)[:3], load_landmark_points(path.with_suffix(".pts")).points
    eyes = float((marks[36] - marks[45]).norm())
    assert sharpness_lines([path], [image], marks[None]) == []
    blurred = cv2.GaussianBlur(image.permute(1, 2, 0).numpy(), (0, 0), 0.025 * eyes)
    lines = sharpness_lines([path], [torch.from_numpy(blurred).permute(2, 0, 1)], marks[None])
    assert len(lines) == 1
    assert "blurred" in lines[0]
    assert f"{path.name} resolves" in lines[0]
