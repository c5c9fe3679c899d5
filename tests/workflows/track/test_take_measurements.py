"""Tests of torchface.workflows.track.take_measurements."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import torch

from torchface.capture import VideoSolver
from torchface.landmarks.images.face_reading import FaceReading
from torchface.shape_names import ARKIT
from torchface.synthetic import performer
from torchface.workflows.track.take_measurements import take_measurements, with_own_brows

FRAMES = 40


def test_brows_that_a_network_does_not_know_come_to_rest_and_others_stay() -> None:
    marks, ones = torch.rand(FRAMES, 68, 2), torch.ones(FRAMES, 68)
    true = 0.2 + 0.2 * torch.linspace(0, 6, FRAMES).sin()
    inner, jaw = ARKIT.index("browInnerUp"), ARKIT.index("jawOpen")
    expression = torch.zeros(FRAMES, 52)
    expression[:, inner], expression[:, jaw] = true + 0.5, true + 0.5
    reading = FaceReading(marks, ones, ones, ones[:, 0], expression=expression)
    lost, sure = (replace(reading, expression_deviation=torch.full((FRAMES, 52), off)) for off in (0.45, 0.2))
    judged = with_own_brows(lost).expression
    assert abs(float((judged[:, inner] - true).mean())) < 0.1
    torch.testing.assert_close(judged[:, inner].diff(), true.diff())
    assert torch.equal(judged[:, jaw], expression[:, jaw])
    assert torch.equal(with_own_brows(sure).expression, expression)
    assert torch.equal(with_own_brows(reading).expression, expression)  # nobody said how sure it is


def test_what_is_read_of_a_hidden_mouth_counts_little() -> None:
    """In the second of two frames no mouth is seen: readings of its shapes have over four times the deviation."""
    solver = VideoSolver(performer(texture=False), None, torch.tensor([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]]))
    visible = torch.ones(2, 68)
    visible[1, 48:] = 0
    read = {"expression": torch.full((2, 52), 0.3), "expression_deviation": torch.full((2, 52), 0.1)}
    reading = FaceReading(300 * torch.rand(2, 68, 2), torch.ones(2, 68), visible, torch.ones(2), **read)
    inputs: Any = SimpleNamespace(models=SimpleNamespace(finder="a network"))
    measured = take_measurements(inputs, solver, reading)
    deviation = measured.weights.deviation
    mouth = [ARKIT.index(f"mouth{name}") for name in ("SmileLeft", "SmileRight", "Pucker")]
    brows = [ARKIT.index(name) for name in ("browDownLeft", "browOuterUpRight")]
    torch.testing.assert_close(deviation[0, mouth + brows], torch.full((5,), 0.1))
    torch.testing.assert_close(deviation[1, brows], torch.full((2,), 0.1))
    assert bool((deviation[1, mouth] > 0.4).all())
