"""Tests of torchface.workflows.track.take_measurements."""

from dataclasses import replace

import torch

from torchface.landmarks.images.face_reading import FaceReading
from torchface.shape_names import ARKIT
from torchface.workflows.track.take_measurements import with_own_brows

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
