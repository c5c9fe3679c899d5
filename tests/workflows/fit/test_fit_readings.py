"""Expressions that were read are counted for each photograph, or for all where all show the same; irises as points."""

import pytest
import torch

from torchface.capture.weight_readings import WeightReadings
from torchface.landmarks import FaceReading
from torchface.modeling import FitSettings
from torchface.shape_names import ARKIT
from torchface.synthetic import performer
from torchface.synthetic.head.identity import sculpted_vertices
from torchface.workflows.fit.fit_readings import ReadExpressions, with_readings


def test_readings_of_photographs() -> None:
    read = torch.tensor([0.2, 0.6])[:, None].expand(2, 52)
    prior = ReadExpressions(None, WeightReadings.of_expression(read, torch.full((2, 52), 0.1), ARKIT))
    each = prior.energy(torch.zeros(2, 52, dtype=torch.float64))
    minimum = -torch.linalg.solve(each.H, each.f[..., None])[..., 0]
    assert torch.allclose(minimum, read.double())
    same = prior.energy(torch.zeros(1, 52, dtype=torch.float64))
    assert torch.allclose(-torch.linalg.solve(same.H, same.f[..., None])[..., 0], torch.full((1, 52), 0.4).double())


@pytest.mark.parametrize(("visible", "closed"), [(0.1, 0.0), (1.0, 0.9)])
def test_irises_that_are_seen_are_points_in_front_of_the_eyeballs(visible: float, closed: float) -> None:
    rig, sure = performer(texture=False), torch.ones(1, 68)
    irises = torch.tensor([[[30.0, 40.0], [60.0, 40.0]]])
    reading = FaceReading(
        60 * torch.rand(1, 68, 2), sure, sure, sure[:, 0], iris=irises, eye_visibility=torch.tensor([[1.0, visible]]),
        closed=torch.tensor([[0.0, closed]]), points=torch.rand(1, 3, 2), point_deviation=torch.ones(1, 3),
    )  # fmt: skip
    surface = with_readings(FitSettings(), reading, sculpted_vertices()[:3].float(), rig).surface
    assert torch.equal(surface.points[0, 3], irises[0, 0])
    assert bool(surface.points[0, 4].isnan().all())  # something hides that eye, or its lids do
    places = surface.sites.on(rig.neutral.faces, rig.vertices)[3:]
    for place, side in zip(places, ("right", "left"), strict=True):
        ball = rig.vertices[rig.neutral.annotations.regions[f"eyeball_{side}"]]
        assert torch.equal(place, ball[ball[:, 2].argmax()])
