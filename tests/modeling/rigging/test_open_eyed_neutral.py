"""Eyes scanned closed are opened as the person's own are."""

import pytest
import torch

from torchface.errors import NameMismatchError, TopologyError
from torchface.modeling import open_eyes, transfer_with_report
from torchface.rig import BlendshapeRig
from torchface.synthetic import draw_identities, performer

BLINKS = ["eyeBlinkLeft", "eyeBlinkRight"]


@pytest.fixture(scope="module")
def template() -> BlendshapeRig:
    return performer(texture=False)


def closed_by_input_lids(rig: BlendshapeRig) -> torch.Tensor:
    return rig.vertices + rig.select(BLINKS).deltas.sum(0)


def test_the_templates_own_closed_face_opens_to_its_neutral(template: BlendshapeRig) -> None:
    opened = open_eyes(template, template.neutral.with_vertices(closed_by_input_lids(template)))
    assert float((opened.vertices - template.vertices).norm(dim=-1).max()) < 1e-3


@pytest.mark.bench
def test_other_performers_eyes_open_as_their_own(template: BlendshapeRig) -> None:
    for identity in draw_identities(2, torch.Generator().manual_seed(1)):
        actor = performer(identity, texture=False)
        closed = actor.neutral.with_vertices(closed_by_input_lids(actor))
        opened = open_eyes(template, closed)
        blink = (closed.vertices - actor.vertices).norm(dim=-1)
        missing = (opened.vertices - actor.vertices).norm(dim=-1)
        assert float(missing[blink > 0.5].mean()) < 0.15 * float(blink[blink > 0.5].mean())
        still = (template.select(BLINKS).deltas == 0).all(-1).all(0)
        assert torch.equal(opened.vertices[still], closed.vertices[still])
        # The rig that transfer makes of the opened face closes its eyes as they were scanned.
        own = transfer_with_report(template.select(BLINKS), opened).rig
        shut = (closed_by_input_lids(own) - closed.vertices).norm(dim=-1)
        assert float(shut.max()) < 0.5
        assert float(shut[blink > 0.5].mean()) < 0.05


def test_shapes_that_close_the_eyes_can_be_named(template: BlendshapeRig) -> None:
    renamed = BlendshapeRig(template.neutral, template.select(BLINKS).deltas, ["shutA", "shutB"])
    closed = template.neutral.with_vertices(closed_by_input_lids(template))
    opened = open_eyes(renamed, closed, ["shutA", "shutB"])
    assert float((opened.vertices - template.vertices).norm(dim=-1).max()) < 1e-3
    with pytest.raises(NameMismatchError, match="eyeBlinkLeft"):
        open_eyes(renamed, closed)


def test_another_topology_is_refused(template: BlendshapeRig, dome_rig: BlendshapeRig) -> None:
    with pytest.raises(TopologyError):
        open_eyes(template, dome_rig.neutral)
