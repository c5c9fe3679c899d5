"""Transfer between performers made by code, whose own true shapes are known."""

from __future__ import annotations

import pytest
import torch

from torchface.modeling.rigging.deformation_transfer import transfer_with_report
from torchface.rig import BlendshapeRig
from torchface.synthetic import draw_identities, performer


@pytest.fixture(scope="module")
def template() -> BlendshapeRig:
    return performer(texture=False)


@pytest.fixture(scope="module")
def others() -> list[BlendshapeRig]:
    return [performer(k, texture=False) for k in draw_identities(4, torch.Generator().manual_seed(0))]


@pytest.mark.bench
def test_transferred_shapes_are_nearer_to_the_truth_than_copied_ones(
    template: BlendshapeRig, others: list[BlendshapeRig]
) -> None:
    transferred = torch.stack([transfer_with_report(template, other.neutral).rig.deltas for other in others])
    truth = torch.stack([other.deltas for other in others])
    assert float((transferred - truth).norm()) < 0.8 * float((template.deltas - truth).norm())


@pytest.mark.bench
def test_lids_of_other_performers_close_where_their_own_do(
    template: BlendshapeRig, others: list[BlendshapeRig]
) -> None:
    blink = template.select(["eyeBlinkLeft", "eyeBlinkRight"])
    annotations = template.neutral.annotations
    assert annotations is not None
    assert annotations.contacts is not None
    first, second = annotations.contacts.T
    pose = template.vertices + blink.deltas.sum(0)
    meet = (pose[first] - pose[second]).norm(dim=-1) < 0.1
    part = (template.vertices[first] - template.vertices[second]).norm(dim=-1) > 3
    assert int((meet & part).sum()) > 20
    first, second = first[meet & part], second[meet & part]

    def gap(rig: BlendshapeRig) -> float:
        shut = rig.vertices + rig.deltas.sum(0)
        return float((shut[first] - shut[second]).norm(dim=-1).max())

    held = max(gap(transfer_with_report(blink, other.neutral).rig) for other in others)
    free = max(gap(transfer_with_report(blink, other.neutral, contact_weight=0.0).rig) for other in others)
    assert held < 0.1 * free
    assert held < 0.1
