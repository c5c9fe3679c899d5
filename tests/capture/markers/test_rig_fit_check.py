"""A take that the rig cannot explain is told from one that it can, and why."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig
from torchface.capture import MarkerSolver
from torchface.capture.markers import check_fit
from torchface.capture.markers.rig_fit_check import unit_of_scale
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import Similarity
from torchface.modeling import transfer_deformation
from torchface.synthetic import draw_identities, performer
from torchface.synthetic.stages.marker_stage import StageFlaws, record

Performance = tuple[BlendshapeRig, Attachment, list[Tensor]]


def sites(rig: BlendshapeRig, attachment: Attachment) -> Tensor:
    solver = MarkerSolver(rig, attachment)
    return torch.cat([solver.rest[..., None], solver.basis], dim=2)


GAPS = StageFlaws(missing=0.02)


def filmed(performance: Performance, flaws: StageFlaws = GAPS) -> Tensor:
    rig, attachment, takes = performance
    take = record(rig, attachment, takes[0][::40], torch.Generator().manual_seed(0), flaws, fps=1.5).take
    return take.markers.values


@pytest.mark.parametrize(
    "flaws",
    [
        GAPS,
        StageFlaws(noise=1.0),
        StageFlaws(missing=0.1, swaps=30, swap_seconds=3),
        StageFlaws(missing=0.6),
    ],
)
def test_what_a_stage_does_wrong_is_no_reason_to_refuse(performance: Performance, flaws: StageFlaws) -> None:
    rig, attachment, _ = performance
    found = check_fit(sites(rig, attachment), filmed(performance, flaws))
    assert not found.refused
    assert found.cause == ""


def test_another_performers_transferred_rig_passes(performance: Performance) -> None:
    rig, attachment, takes = performance
    truth = performer(draw_identities(1, torch.Generator().manual_seed(3))[0], texture=False)
    solved_with = transfer_deformation(rig, truth.neutral)
    weights = takes[0][::40]
    take = record(truth, attachment, weights, torch.Generator().manual_seed(0)).take
    assert check_fit(sites(solved_with, attachment), take.markers.values).cause == ""


def test_a_slipping_helmet_is_named_and_passes_once_its_motion_is_taken_out(performance: Performance) -> None:
    rig, attachment, _ = performance
    markers = filmed(performance, StageFlaws(slip_translation=8, slip_rotation=3))
    found = check_fit(sites(rig, attachment), markers)
    assert found.cause == "slip"
    assert found.corrected < 0.2 * found.distance
    assert check_fit(sites(rig, attachment), markers, slip=True).distance == pytest.approx(found.corrected, abs=0.1)


@pytest.mark.parametrize("way", [0.0, 4.0, 10.0])
def test_a_helmet_may_slip_that_carries_five_markers_and_their_sites_are_still_checked(way: float) -> None:
    rig = performer(texture=False).select(["jawOpen", "mouthSmileLeft", "mouthSmileRight", "browInnerUp"])
    attachment = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks[[27, 30, 36, 45, 54]])
    generator = torch.Generator().manual_seed(0)
    take = record(rig, attachment, torch.rand(40, 4, generator=generator), generator, StageFlaws(noise=0.1)).take
    phase = torch.linspace(0, 6, 40)
    slip = rotation_matrix(0.01 * way * torch.stack([phase.sin(), phase.cos(), 0 * phase], 1))
    shift = way * torch.stack([phase.sin(), 0 * phase, phase.cos()], 1)
    markers = take.markers.values @ slip.transpose(1, 2) + shift[:, None]
    found = check_fit(sites(rig, attachment), markers, slip=True)
    assert found.cause == ""
    assert found.distance < 0.3
    others = check_fit(sites(rig, attachment).roll(1, 0), markers, slip=True)
    assert others.refused
    assert others.cause == "attachment"


def test_a_take_that_shows_nothing_has_no_cause(performance: Performance) -> None:
    rig, attachment, _ = performance
    nothing = torch.full((3, 100, 3), torch.nan)
    found = [check_fit(sites(rig, attachment), nothing, slip) for slip in (False, True)]
    assert [(each.cause, each.refused) for each in found] == [("", True)] * 2


def test_few_markers_close_together_may_stand_off_the_skin(performance: Performance) -> None:
    rig, attachment, takes = performance
    points = attachment.on(rig.neutral.faces, rig.vertices)
    near = (points - points[points[:, 1].argmax()]).norm(dim=1).argsort()[:8]
    brow = attachment.select([(attachment.labels or ())[i] for i in near.tolist()])
    take = record(rig, brow, takes[0][::40], torch.Generator().manual_seed(0), StageFlaws(standoff=3)).take
    found = check_fit(sites(rig, brow), take.markers.values)
    assert found.radius < 30
    assert not found.refused


@pytest.mark.parametrize("slip", [False, True])
def test_a_take_in_another_space_is_refused_for_its_alignment(
    performance: Performance, stage_space: Similarity, slip: bool
) -> None:
    rig, attachment, _ = performance
    found = check_fit(sites(rig, attachment), stage_space.apply(filmed(performance)), slip)
    assert found.refused
    assert found.cause == "alignment"
    assert found.distance > 100
    assert found.corrected < 0.6


@pytest.mark.parametrize(
    ("factor", "unit", "elsewhere"),
    [(1e-3, "m", False), (0.1, "cm", True), (1 / 25.4, "in", False), (10.0, "mm", True)],
)
def test_a_wrong_unit_is_told_by_its_scale(
    performance: Performance, stage_space: Similarity, factor: float, unit: str, elsewhere: bool
) -> None:
    rig, attachment, _ = performance
    markers = filmed(performance)
    found = check_fit(sites(rig, attachment), factor * (stage_space.apply(markers) if elsewhere else markers))
    assert found.refused
    assert (found.cause, found.unit) == ("unit", unit)
    assert found.corrected < 0.6


def test_sites_of_other_markers_are_refused_wherever_the_take_lies(performance: Performance) -> None:
    rig, attachment, _ = performance
    order = torch.randperm(100, generator=torch.Generator().manual_seed(1))
    others = replace(attachment, triangles=attachment.triangles[order], barycentric=attachment.barycentric[order])
    markers = filmed(performance)
    found = check_fit(sites(rig, others), markers)
    assert found.refused
    assert found.cause == "attachment"
    laid = check_fit(sites(rig, others), found.similarity.apply(markers))
    assert laid.refused
    assert laid.cause == "attachment"
    # A move brings them to less than half of the distance, and still not to their sites.
    assert check_fit(sites(rig, others), markers + torch.tensor([150.0, 0.0, 0.0])).cause == "attachment"


def test_units_by_scale() -> None:
    found = [unit_of_scale(scale) for scale in (1.0, 1.1, 930.0, 9.6, 25.0, 0.1, 0.0011, 3.0, 0.0)]
    assert found == ["", "", "m", "cm", "in", "mm", "mm", "", ""]
    assert [unit_of_scale(0.001, unit) for unit in ("mm", "m", "cm")] == ["um", "mm", ""]
    assert [unit_of_scale(0.1, unit) for unit in ("mm", "cm")] == ["", "mm"]
    assert [unit_of_scale(1000.0, unit) for unit in ("mm", "um")] == ["m", "mm"]


@pytest.mark.real
def test_real_takes_pass_and_the_same_on_other_sites_do_not(
    real_capture: tuple[BlendshapeRig, Attachment, list[Tensor]],
) -> None:
    rig, attachment, takes = real_capture
    order = torch.randperm(100, generator=torch.Generator().manual_seed(0))
    others = replace(attachment, triangles=attachment.triangles[order], barycentric=attachment.barycentric[order])
    for weights in takes[:3]:
        take = record(rig, attachment, weights[::30], torch.Generator().manual_seed(0), GAPS, fps=2).take
        found = check_fit(sites(rig, attachment), take.markers.values)
        assert found.cause == ""
        assert found.distance < 0.5
    wrong = check_fit(sites(rig, others), take.markers.values)
    assert wrong.refused
    assert wrong.cause == "attachment"
    in_metres = check_fit(sites(rig, attachment), take.markers.values / 1000)
    assert in_metres.refused
    assert (in_metres.cause, in_metres.unit) == ("unit", "m")
