"""Tracing planted dark lines, and the local optimality that iterated conditional modes promises."""

import math

import numpy as np
import pytest
import torch

from torchface.errors import ValueRangeError
from torchface.landmarks.scans import contours
from torchface.landmarks.scans.contours import evenly_spaced, trace_contour
from torchface.landmarks.scans.line_shape import LineShape
from torchface.rendering.gaussian_blur import gaussian_blur

COLUMNS = torch.arange(60.0, 161.0)


def planted(sag: float, seed: int = 0, contrast: float = 0.4) -> tuple[torch.Tensor, torch.Tensor]:
    """Skin with noise and a dark line from (60,110) to (160,104); the line's rows."""
    rows = 110 - 0.06 * (COLUMNS - 60) + sag * torch.sin(math.pi * (COLUMNS - 60) / 100)
    y = torch.arange(220.0)[:, None]
    image = torch.full((220, 220), 0.7)
    image[:, 60:161] -= contrast * torch.exp(-0.5 * ((y - rows) / 2.0) ** 2)
    image += 0.04 * torch.randn(220, 220, generator=torch.Generator().manual_seed(seed))
    return image[None], rows


@pytest.mark.parametrize("sag", [0.0, 7.0, 13.0, -6.0])
def test_a_planted_line_is_found(sag: float) -> None:
    image, rows = planted(sag)
    found = trace_contour(image, torch.tensor([60.0, 113.0]), torch.tensor([160.0, 101.0]))
    assert torch.equal(found.points[:, 0].float(), COLUMNS)
    error = (found.points[:, 1] - rows).abs()
    assert error[found.kept].mean() < 1.0
    assert error[found.kept].max() < 4.0
    assert found.kept.float().mean() > 0.7


def test_a_brighter_second_line_does_not_distract() -> None:
    image, rows = planted(6.0)
    y = torch.arange(220.0)[:, None]
    image[0, :, 60:161] -= 0.2 * torch.exp(-0.5 * ((y - rows + 30) / 2.0) ** 2)
    found = trace_contour(image, torch.tensor([60.0, 110.0]), torch.tensor([160.0, 104.0]))
    assert (found.points[:, 1] - rows)[found.kept].abs().mean() < 1.0


def test_no_single_column_can_do_better(monkeypatch: pytest.MonkeyPatch) -> None:
    image, _ = planted(9.0, seed=3)
    monkeypatch.setattr(contours, "_SAGS", (0.08,))
    monkeypatch.setattr(contours, "_ITERATIONS", 100)
    left, right = torch.tensor([60.0, 110.0]), torch.tensor([160.0, 104.0])
    found = trace_contour(image, left, right)
    top = 104 - contours._BORDER
    box = gaussian_blur(image[:, top : 110 + contours._BORDER + 1, 60:161][None], contours._BLUR)[0, 0].double()
    rows, width = np.arange(len(box)), contours._LINE_WIDTH
    grey = box.numpy()
    grey = grey - np.minimum(grey[np.maximum(rows - width, 0)], grey[np.minimum(rows + width, len(rows) - 1)])
    grey = (grey - grey.min()) / grey.std()
    path = (found.points[:, 1] - top).long().numpy()
    course, deviation = LineShape.arc(0.08, contours._DEVIATION).rows(left, right, COLUMNS)
    limit = grey[path, np.arange(101)].mean() + grey[path, np.arange(101)].std()
    for c in range(1, 100):
        away = (rows - float(course[c]) + top) / float(deviation[c])
        cost = contours._DARK * grey[:, c] + contours._NEAR * away**2
        for n in (c - 1, c + 1):
            cost = cost + contours._SIMILAR * (grey[:, c] - grey[path[n], n]) ** 2
            cost = cost + contours._SMOOTH * (rows - path[n]) ** 2
        cost = cost + 4.0 * (grey[:, c] > limit)
        assert cost[path[c]] <= cost.min() + 1e-9


def test_the_usual_course_is_learned_and_decides_between_two_lines() -> None:
    lines = [torch.stack([COLUMNS, planted(sag)[1]], dim=-1) for sag in (5.0, 6.0, 7.0)]
    shape = LineShape.fit(lines)
    rows, deviation = shape.rows(torch.tensor([60.0, 110.0]), torch.tensor([160.0, 104.0]), COLUMNS)
    assert (rows - planted(6.0)[1]).abs().max() < 0.2
    assert (deviation >= 2.0 - 1e-6).all()
    image, truth = planted(6.0)
    y = torch.arange(220.0)[:, None]
    image[0, :, 60:161] -= 0.45 * torch.exp(-0.5 * ((y - truth - 25) / 2.0) ** 2)  # darker, elsewhere
    found = trace_contour(image, torch.tensor([60.0, 113.0]), torch.tensor([160.0, 101.0]), shape=shape)
    assert (found.points[:, 1] - truth)[found.kept].abs().mean() < 1.0


def test_what_is_brighter_than_the_line_is_marked() -> None:
    image, rows = planted(5.0)
    image[:, :, 100:110] = 0.7  # the line is hidden here
    found = trace_contour(image, torch.tensor([60.0, 110.0]), torch.tensor([160.0, 104.0]))
    assert not found.kept[42:48].any()
    assert (found.points[:, 1] - rows)[found.kept].abs().mean() < 1.0


def test_points_are_evenly_spaced() -> None:
    image, _ = planted(9.0)
    found = trace_contour(image, torch.tensor([60.0, 110.0]), torch.tensor([160.0, 104.0]))
    some = found.resampled(15)
    assert torch.allclose(some[0], found.points[0])
    assert torch.allclose(some[-1], found.points[-1])
    circle = torch.linspace(0, math.pi, 500, dtype=torch.float64)
    arc = evenly_spaced(torch.stack([circle.cos(), circle.sin()], dim=-1), 13)
    steps = (arc[1:] - arc[:-1]).norm(dim=-1)
    assert (steps - steps.mean()).abs().max() < 1e-4


def test_corners_the_wrong_way_round_are_refused() -> None:
    image, _ = planted(0.0)
    with pytest.raises(ValueRangeError, match="left of the right"):
        trace_contour(image, torch.tensor([160.0, 104.0]), torch.tensor([60.0, 110.0]))
    with pytest.raises(ValueRangeError, match="expected pixels of an image"):
        trace_contour(image, torch.tensor([math.nan, 104.0]), torch.tensor([60.0, 110.0]))
