"""What a range of motion does not tell is said, what the rig does not explain is refused, and slip is solved along."""

import math
from dataclasses import replace

import pytest
import torch
from displaced_sites import misplaced, site_distances
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Take, Track
from torchface.capture import fit_attachment
from torchface.capture.markers import AttachmentFit, SiteUncertainty
from torchface.capture.markers.attachment.attachment_fit import check_sites
from torchface.capture.markers.attachment.site_curvature import SitesOnTake, TakeCurvature, pose_columns
from torchface.errors import AlignmentError, ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.synthetic import draw_identities, performer
from torchface.synthetic.stages.marker_stage import StageFlaws, record

Performance = tuple[BlendshapeRig, Attachment, list[Tensor]]


def filmed(performance: Performance, flaws: StageFlaws | None = None, take: int = 0, every: int = 40) -> Take:
    rig, attachment, takes = performance
    generator = torch.Generator().manual_seed(0)
    return record(rig, attachment, takes[take][::every], generator, flaws or StageFlaws(), fps=60.0 / every).take


def guess(rig: BlendshapeRig, attachment: Attachment, seed: int = 1, least: float = 2, most: float = 8) -> Attachment:
    return misplaced(rig, attachment, torch.Generator().manual_seed(seed), least, most)


@pytest.fixture(scope="module")
def calm_fit(performance: Performance) -> AttachmentFit:
    rig, attachment, takes = performance
    calm = (rig, attachment, [0.4 * takes[0]])
    return fit_attachment(rig, filmed(calm, every=12), guess(rig, attachment))


def test_a_calm_take_gives_the_sites_and_names_the_shapes_that_it_leaves_open(
    performance: Performance, calm_fit: AttachmentFit
) -> None:
    rig, attachment, takes = performance
    assert (site_distances(rig, calm_fit.attachment, attachment) < 1.0).float().mean() >= 0.98
    known = calm_fit.uncertainty
    assert not known.mostly_uncertain
    assert known.noise == pytest.approx(0.3, abs=0.03)
    off = (calm_fit.weights - 0.4 * takes[0][::12]).mean(0).abs()
    wrong = {name for name, error in zip(rig.names, off.tolist(), strict=True) if error > 0.1}
    assert wrong <= {*known.shapes, *known.unseen}
    # Deviations are not so large that they say nothing, nor too small: errors stay within three of them.
    assert (off <= 3 * known.levels).float().mean() >= 0.9
    assert len(known.shapes) + len(known.unseen) <= len(rig.names) / 2


@pytest.mark.bench
def test_a_guess_that_is_far_off_still_ends_at_the_sites(performance: Performance) -> None:
    rig, attachment, _ = performance
    take = filmed(performance, take=1, every=6)
    fit = fit_attachment(rig, take, guess(rig, attachment, 3, 8, 15))
    assert (site_distances(rig, fit.attachment, attachment) < 1.0).float().mean() >= 0.98


def test_without_slip_none_is_found(calm_fit: AttachmentFit) -> None:
    assert calm_fit.motion is None


def on_a_helmet(take: Take, rows: list[int]) -> Take:
    values = take.markers.values.clone()
    noise = 0.3 * torch.randn(len(values), len(rows), 3, generator=torch.Generator().manual_seed(2))
    place = torch.tensor([[-70.0, 90, 90], [-30, 120, 110], [30, 120, 110], [70, 90, 90]])
    values[:, rows] = place[: len(rows)] + noise
    return replace(take, markers=Track(take.markers.names, values))


@pytest.mark.parametrize("rows", [[4, 30, 55, 80], pytest.param([1, 2, 3, 4], marks=pytest.mark.bench)])
def test_markers_on_the_helmet_are_named_and_disturb_no_other(performance: Performance, rows: list[int]) -> None:
    rig, attachment, _ = performance
    take = on_a_helmet(filmed(performance), rows)
    labels = attachment.labels or ()
    with pytest.raises(AlignmentError, match="sit on the helmet") as refusal:
        fit_attachment(rig, take, guess(rig, attachment))
    assert all(labels[row] in str(refusal.value) for row in rows)
    fit = fit_attachment(rig, take, guess(rig, attachment), insist=True)
    others = attachment.select([label for i, label in enumerate(labels) if i not in rows])
    assert (site_distances(rig, fit.attachment, others) < 1.0).float().mean() >= 0.95


def test_another_heads_rig_is_refused(performance: Performance) -> None:
    rig, attachment, takes = performance
    other = performer(draw_identities(1, torch.Generator().manual_seed(5))[0], texture=False)
    on_other = replace(attachment, fingerprint=other.neutral.fingerprint())
    take = filmed((other, on_other, takes))
    with pytest.raises(AlignmentError, match=r"mm off the rig's skin all the time.*another head"):
        fit_attachment(rig, take, guess(rig, attachment))


def test_mixed_labels_are_refused(performance: Performance) -> None:
    rig, attachment, _ = performance
    take = filmed(performance)
    order = torch.randperm(100, generator=torch.Generator().manual_seed(1)).tolist()
    mixed = Take(60.0, markers=Track([take.markers.names[i] for i in order], take.markers.values))
    with pytest.raises(AlignmentError, match="labels are mixed up"):
        fit_attachment(rig, mixed, guess(rig, attachment))


def test_most_uncertain_is_refused() -> None:
    def open_sites(sites: Tensor, levels: Tensor) -> SiteUncertainty:
        return SiteUncertainty(
            tuple("abcdef"), ("M1", "M2", "M3"), sites, levels, torch.tensor([0.3, 0, 0, 0, 0, 0]), noise=0.3
        )

    def check(known: SiteUncertainty) -> None:
        check_sites(known.labels, torch.full((3,), 0.5), torch.full((3,), 0.05), 50.0, known)

    some, most = torch.tensor([0.2, 2, 0.2]), torch.tensor([0.2, 2, 3])
    few, many = torch.tensor([0.3, 0.2, 0.2, 0, 0, 0]), torch.tensor([0.3, 0.2, 0.2, 0.1, 0, 0])
    known = open_sites(some, few)
    check(known)
    assert known.unseen == ("a",)
    assert known.shapes == ("b", "c")
    assert known.markers == ("M2",)
    with pytest.raises(ValueRangeError, match=r"leaves 2 of 3 sites uncertain"):
        check(open_sites(most, few))
    with pytest.raises(ValueRangeError, match=r"3 of 5 shapes that the markers see \(b, c, d\)"):
        check(open_sites(some, many))


@pytest.mark.parametrize("slips", [False, True])
def test_the_curvature_is_that_of_all_unknowns_with_the_weights_eliminated(slips: bool) -> None:
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator).double()

    here, tangents, moved = 10 * drawn(9, 3, 5), drawn(9, 2, 3, 5), 10 * drawn(3, 9, 3)
    weights, ridge = torch.tensor([[0.2, 0, 0.7, 1], [0.5, 0.5, 0, 0], [0.1, 0.9, 0.3, 0.4]]).double(), 0.3
    moved[1, 4] = torch.nan
    frames = 3 if slips else 1
    pose = Similarity(torch.ones(frames), torch.eye(3).repeat(frames, 1, 1), torch.zeros(frames, 3))
    columns = pose_columns(torch.einsum("mcn,tn->tmc", here[..., 1:], weights) + here[..., 0], pose)
    found = TakeCurvature.of(SitesOnTake(here, tangents, moved, weights, columns, slips), ridge)
    outer, motions = len(found.gradient), 6 if slips else 0
    inner = 4 + motions

    def energy(unknown: Tensor) -> Tensor:
        shift, change = unknown[:outer], unknown[outer:].unflatten(0, (3, inner))
        moving = torch.where((weights > 0) & (weights < 1), change[:, :4], torch.zeros_like(weights))
        extended = torch.cat([torch.ones(3, 1).double(), weights], 1)
        on_rig = torch.einsum("mcn,tn->tmc", here, extended) + torch.einsum("mcn,tn->tmc", here[..., 1:], moving)
        follow = torch.einsum("mkcn,tn->tmkc", tangents, extended)
        on_rig = on_rig + torch.einsum("tmkc,mk->tmc", follow, shift[:18].unflatten(0, (9, 2)))
        total = 0.5 * 9 * ridge * (weights + moving).square().sum()
        if slips:
            rest = here[..., 0]
            arm = rest - rest.mean(0)
            rigid = change[:, 4:]
            turn = torch.linalg.cross(rigid[:, None, 3:].expand(3, 9, 3), arm.expand(3, 9, 3), dim=-1) / 30
            on_rig = on_rig + rigid[:, None, :3] + turn
            total = total + 0.5 * 9 * 1e-4 * rigid.square().sum()
        left = moved + columns @ shift[18:] - on_rig
        return total + 0.5 * torch.where(torch.isnan(left), 0.0, left).square().sum()

    zero = torch.zeros(outer + 3 * inner, dtype=torch.float64)
    hessian = torch.autograd.functional.hessian(energy, zero)
    gradient = torch.autograd.functional.jacobian(energy, zero)
    free = hessian.diagonal() > 0  # held weights move nothing
    free[:outer] = True
    step = torch.zeros_like(zero)
    stiffness = torch.full((outer,), 0.1, dtype=torch.float64)
    hessian[range(outer), range(outer)] += stiffness
    step[free] = torch.linalg.solve(hessian[free][:, free], -gradient[free])
    shift, change = found.step(stiffness, torch.zeros_like(stiffness))
    torch.testing.assert_close(shift, step[:outer], rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(change.flatten(), step[outer:], rtol=1e-6, atol=1e-8)
    inverse = torch.linalg.inv(hessian[free][:, free])[:outer, :outer]
    torch.testing.assert_close(
        torch.linalg.inv(found.information + torch.diag(stiffness)), inverse, rtol=1e-6, atol=1e-8
    )
    assert math.isfinite(float(found.information.sum()))
