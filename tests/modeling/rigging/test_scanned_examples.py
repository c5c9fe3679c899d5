"""An example keeps what its scan has shown and forgets what it has not."""

import pytest
import torch

from torchface.errors import ShapeError
from torchface.modeling.rigging.scanned_examples import seen_example
from torchface.rig import BlendshapeRig


def test_seen_vertices_keep_their_offset_and_unseen_ones_return_to_what_was_expected(dome_rig: BlendshapeRig) -> None:
    expected = dome_rig.vertices.double()
    seen = expected[:, 0] < 0
    noise = torch.randn(expected.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    smooth = torch.stack([torch.zeros(len(expected)), expected[:, 1].sin() * 0, expected[:, 1] / 25], dim=-1)
    offset = torch.where(seen[:, None], smooth, 3 * noise)
    found = dome_rig.neutral.with_vertices(expected + offset)
    example = seen_example(found, expected, seen)
    deep = expected[:, 0] < -10
    assert float((example - expected - smooth)[deep].norm(dim=-1).max()) < 0.06
    far = expected[:, 0] > 45
    assert float((example - expected)[far].norm(dim=-1).max()) < 0.5
    everything = seen_example(
        found, expected, torch.ones(len(expected), dtype=torch.bool), data_weight=1e6, damping=1e-6
    )
    torch.testing.assert_close(everything, found.vertices, atol=1e-3, rtol=0)
    nothing = seen_example(found, expected, torch.zeros(len(expected), dtype=torch.bool))
    torch.testing.assert_close(nothing, expected, atol=1e-9, rtol=0)


def test_it_is_the_optimum_of_its_cost(dome_rig: BlendshapeRig) -> None:
    expected = dome_rig.vertices.double()
    generator = torch.Generator().manual_seed(1)
    offset = torch.randn(expected.shape, generator=generator, dtype=torch.float64)
    seen = torch.rand(len(expected), generator=generator) > 0.4
    best = seen_example(dome_rig.neutral.with_vertices(expected + offset), expected, seen, 3.0, 0.2) - expected
    y = best.clone().requires_grad_()
    faces = dome_rig.neutral.faces
    pairs = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values.unique(dim=0)
    cost = 3 * (y - offset)[seen].square().sum() + (y[pairs[:, 0]] - y[pairs[:, 1]]).square().sum()
    (slope,) = torch.autograd.grad(cost + 0.2 * y.square().sum(), y)
    assert float(slope.abs().max()) < 1e-9


def test_other_shapes_are_refused(dome_rig: BlendshapeRig) -> None:
    with pytest.raises(ShapeError, match="seen_example"):
        seen_example(dome_rig.neutral, dome_rig.vertices[:5], torch.ones(5, dtype=torch.bool))
