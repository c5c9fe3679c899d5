"""Sites that were guessed wrong come back to where the markers were."""

from dataclasses import replace

import pytest
import torch
from displaced_sites import misplaced, site_distances
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Take, Track
from torchface.capture import MarkerSolver, align_take, fit_attachment, rest_residual
from torchface.capture.markers import HelmetMotion, sites_by_shape
from torchface.capture.markers.attachment.best_sites import PathMoments, best_sites
from torchface.capture.markers.surface_motion import SurfaceMotion, with_one
from torchface.errors import AlignmentError, NameMismatchError, TopologyError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix, rotation_vector
from torchface.geometry.similarity import Similarity
from torchface.synthetic import performer
from torchface.synthetic.stages import StageFlaws, place_markers, record

Performance = tuple[BlendshapeRig, Attachment, list[Tensor]]


def filmed(
    performance: Performance, take: int, space: Similarity, seed: int = 0, flaws: StageFlaws | None = None
) -> Take:
    rig, attachment, takes = performance
    recording = record(rig, attachment, takes[take], torch.Generator().manual_seed(seed), flaws or StageFlaws())
    return replace(recording.take, markers=Track(attachment.labels or (), space.apply(recording.take.markers.values)))


def by_nearest_vertex(rig: BlendshapeRig, sites: Attachment) -> Attachment:
    points = sites.on(rig.neutral.faces, rig.vertices)
    return Attachment.from_vertices(rig.neutral, torch.cdist(points, rig.vertices).argmin(1), sites.labels)


def error_with(rig: BlendshapeRig, sites: Attachment, take: Take, true: Tensor) -> float:
    """Mean error of the weights, the take aligned to these sites and what is left at rest subtracted."""
    alignment = align_take(rig, sites, take)
    solved = MarkerSolver(rig, rest_residual(rig, sites, take, alignment), alignment).solve_take(take)
    return float((solved.weights.values[..., 0] - true).abs().mean())


@pytest.mark.bench  # a calm take of the performer gives its sites everyday
def test_sites_on_the_performer_come_back(performance: Performance, stage_space: Similarity) -> None:
    rig, attachment, takes = performance
    performance = (rig, attachment, [takes[0][::10], takes[1][::10]])
    start = misplaced(rig, attachment, torch.Generator().manual_seed(1))
    assert float(site_distances(rig, start, attachment).min()) > 1.9
    fit = fit_attachment(rig, filmed(performance, 0, stage_space), start)
    assert fit.attachment.labels == attachment.labels
    assert (site_distances(rig, fit.attachment, attachment) < 1.0).float().mean() >= 0.95
    assert float(fit.errors[-1].mean()) < 0.55  # 0.3 mm of noise a coordinate is 0.52
    assert fit.errors.shape[1] == len(attachment.triangles)
    assert abs(float(fit.alignment.scale * stage_space.scale) - 1) < 0.01
    # Another take, the helmet put on anew.
    again = Similarity(stage_space.scale, stage_space.rotation.transpose(1, 2), -stage_space.translation)
    take, true = filmed(performance, 1, again, 2), takes[1][::10]
    ours = error_with(rig, fit.attachment, take, true)
    assert ours <= 0.6 * error_with(rig, by_nearest_vertex(rig, start), take, true)


def test_markers_that_stand_off_the_skin(performance: Performance, stage_space: Similarity) -> None:
    rig, attachment, takes = performance
    short = (rig, attachment, [takes[0][::12]])
    take = filmed(short, 0, stage_space, flaws=StageFlaws(standoff=2.0))
    fit = fit_attachment(rig, take, misplaced(rig, attachment, torch.Generator().manual_seed(1)), standoff=True)
    assert (site_distances(rig, fit.attachment, attachment) < 1.0).float().mean() >= 0.85
    assert 1.4 < fit.standoff < 2.2
    assert 1.4 < float(fit.attachment.residual.norm(dim=1).mean()) < 2.3


def test_the_best_site_is_the_best_of_all_points_tried(performance: Performance) -> None:
    rig, attachment, takes = performance
    weights = takes[0][::40].double()
    motion = SurfaceMotion.of(rig)
    generator = torch.Generator().manual_seed(3)
    extended = with_one(weights)
    paths = torch.einsum("mcn,tn->tmc", motion.at(motion.points, attachment), extended)
    paths = paths + torch.randn(1, *paths.shape[1:], generator=generator).double()
    candidates = torch.stack([attachment.triangles, attachment.triangles.roll(1)], 1)
    found = best_sites(motion.points, rig.neutral.faces, candidates, PathMoments.of(paths, extended))

    def error(triangles: Tensor, barycentric: Tensor) -> Tensor:
        sites = motion.at(motion.points, Attachment(triangles, barycentric))
        distance = (torch.einsum("mcn,tn->tmc", sites, extended) - paths).square().sum(-1)
        return distance.nanmean(0).sqrt()

    torch.testing.assert_close(error(found.triangles, found.barycentric), found.error, rtol=0, atol=2e-3)
    for _ in range(20):
        corners = torch.rand(len(candidates), 3, generator=generator).double()
        corners = corners / corners.sum(1, keepdim=True)
        for column in (0, 1):
            assert (error(candidates[:, column], corners) >= found.error - 2e-3).all()


@pytest.mark.bench
def test_gaps_do_not_matter_much(performance: Performance, stage_space: Similarity) -> None:
    rig, attachment, takes = performance
    short = (rig, attachment, [takes[0][::6]])
    take = filmed(short, 0, stage_space, flaws=StageFlaws(missing=0.3))
    fit = fit_attachment(rig, take, misplaced(rig, attachment, torch.Generator().manual_seed(1)))
    assert (site_distances(rig, fit.attachment, attachment) < 1.0).float().mean() >= 0.9


def test_bad_takes_say_what_is_wrong(performance: Performance) -> None:
    rig, attachment, _ = performance
    still = attachment.on(rig.neutral.faces, rig.vertices).expand(30, -1, -1)
    labels = attachment.labels or ()
    with pytest.raises(ValueRangeError, match=r"half of the markers move less than 0\.00 mm"):
        fit_attachment(rig, Take(60.0, markers=Track(labels, still)), attachment)
    unseen = still.clone()
    unseen[:, 3] = torch.nan
    with pytest.raises(ValueRangeError, match=r"1 of 100 are seen in no frame \(M004\)"):
        fit_attachment(rig, Take(60.0, markers=Track(labels, unseen)), attachment)
    line = torch.linspace(0, 1, 100)[:, None] * torch.tensor([100.0, 50, 20]) + torch.zeros(30, 1, 1)
    with pytest.raises(AlignmentError, match="on a line"):
        fit_attachment(rig, Take(60.0, markers=Track(labels, line)), attachment)
    with pytest.raises(AlignmentError, match="on a line"):
        align_take(rig, attachment, Take(60.0, markers=Track(labels, line)))
    with pytest.raises(AlignmentError, match="on a line"):
        align_take(rig, attachment, Take(60.0, markers=Track(labels, line)), neutral_frame=0)
    with pytest.raises(NameMismatchError, match=r"'\*17'"):
        fit_attachment(rig, Take(60.0, markers=Track(["*17"], still[:, :1])), attachment)
    with pytest.raises(NameMismatchError, match="no marker at all"):
        fit_attachment(rig, Take(60.0), attachment)
    with pytest.raises(TopologyError):
        fit_attachment(rig, Take(60.0), replace(attachment, fingerprint="another"))
    with pytest.raises(ValueRangeError, match="expected frame 30 among them"):
        align_take(rig, attachment, Take(60.0, markers=Track(labels, still)), neutral_frame=30)


def test_the_first_guess_is_found_by_shape(performance: Performance, stage_space: Similarity) -> None:
    rig, attachment, _ = performance
    take = filmed(performance, 1, stage_space)
    guess = sites_by_shape(rig, take)
    assert guess.labels == attachment.labels
    assert site_distances(rig, guess, attachment).median() < 4.0
    assert site_distances(rig, guess, attachment).max() < 10.0
    few = Take(60.0, markers=take.markers.select(take.markers.names[:8]))
    with pytest.raises(ValueRangeError, match="found 8, expected at least 12"):
        sites_by_shape(rig, few)
    small = Take(60.0, markers=Track(take.markers.names, 0.1 * take.markers.values))
    with pytest.raises(AlignmentError, match=r"in cm \(--unit cm\)"):
        sites_by_shape(rig, small)
    blown = take.markers.values + 60 * torch.randn(
        take.markers.values.shape[1:], generator=torch.Generator().manual_seed(1)
    )
    scattered = Take(60.0, markers=Track(take.markers.names, blown))
    with pytest.raises(AlignmentError, match=r"markers: .*best fit.*by --initial") as refused:
        sites_by_shape(rig, scattered)
    assert "register" not in str(refused.value)
    assert "landmarks" not in str(refused.value)


def test_the_motion_of_a_slipping_helmet_is_the_one_that_moved_the_markers() -> None:
    rig = performer(texture=False).select(["jawOpen", "mouthPucker", "mouthSmileLeft", "mouthSmileRight"])
    sites = place_markers(rig, 40)
    weights = torch.rand(60, len(rig.names), generator=torch.Generator().manual_seed(0)).square()
    take = record(rig, sites, weights, torch.Generator().manual_seed(0), StageFlaws(noise=0.1)).take
    phase = torch.arange(len(take)) / 10
    turn = rotation_matrix(0.12 * torch.stack([0.3 * phase.sin(), phase.cos(), 0 * phase], 1))
    way = 8 * torch.stack([phase.sin(), 0 * phase, phase.cos()], 1)
    planted = HelmetMotion(turn, way, sites.on(rig.neutral.faces, rig.vertices).mean(0))
    slid = replace(take, markers=Track(take.markers.names, planted.apply(take.markers.values)))
    fit = fit_attachment(rig, slid, sites, insist=True)
    on_face = sites.on(rig.neutral.faces, rig(weights))
    undone = fit.motion.undo(fit.alignment.apply(slid.markers.values.double()))
    assert (undone - on_face).norm(dim=-1).median() < 0.3
    # Both are relative to some pose of the helmet.
    steps = fit.motion.rotation.float() @ fit.motion.rotation[0].T.float()
    angles = rotation_vector(steps @ (turn @ turn[0].T).transpose(1, 2)).norm(dim=1)
    assert torch.rad2deg(angles).max() < 0.5
