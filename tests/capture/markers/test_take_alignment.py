"""A take is aligned to the rig, whether it holds a neutral frame or not."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Take, Track
from torchface.capture import MarkerSolver, align_take, fit_attachment, rest_residual
from torchface.errors import AlignmentError
from torchface.geometry.mirrored_points import check_mirrored
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import Similarity
from torchface.synthetic.stages.marker_stage import StageFlaws, record

Performance = tuple[BlendshapeRig, Attachment, list[Tensor]]


def moved(take: Take, space: Similarity) -> Take:
    return replace(take, markers=Track(take.markers.names, space.apply(take.markers.values)))


def off_by(found: Similarity, space: Similarity, points: Tensor) -> float:
    """How far points of the rig come back from where they went, largest, millimetres."""
    return float((found.apply(space.apply(points[None]).double()) - points).norm(dim=-1).max())


def test_a_neutral_frame_gives_the_similarity_exactly(performance: Performance, stage_space: Similarity) -> None:
    rig, attachment, takes = performance
    weights = takes[0][:40].clone()
    weights[17] = 0
    take = record(rig, attachment, weights, torch.Generator().manual_seed(0), StageFlaws(noise=0)).take
    found = align_take(rig, attachment, moved(take, stage_space), neutral_frame=17)
    at_rest = attachment.on(rig.neutral.faces, rig.vertices)
    assert off_by(found, stage_space, at_rest) < 5e-3
    assert off_by(align_take(rig, attachment, moved(take, stage_space), 20), stage_space, at_rest) > 0.1


def test_a_take_without_a_neutral_frame(performance: Performance, stage_space: Similarity) -> None:
    rig, attachment, takes = performance
    weights = takes[0][::10].clone()
    weights[:, rig.index(["browInnerUp", "mouthSmileLeft", "mouthSmileRight"])] += 0.3
    weights = weights.clamp(0, 1)
    take = record(rig, attachment, weights, torch.Generator().manual_seed(0), StageFlaws(missing=0.05)).take
    found = align_take(rig, attachment, moved(take, stage_space))
    assert off_by(found, stage_space, attachment.on(rig.neutral.faces, rig.vertices)) < 1.0
    # The similarity goes to the solver, which then reads the take in its own space.
    solver = MarkerSolver(rig, attachment, found)
    solved = solver.solve_take(moved(take, stage_space)).weights
    best = MarkerSolver(rig, attachment).solve_take(take).weights
    error, least = ((w.values[..., 0] - weights).abs().mean() for w in (solved, best))
    assert error < 1.25 * least


def test_a_head_that_moves_in_the_volume_does_not_shrink(performance: Performance, stage_space: Similarity) -> None:
    rig, attachment, takes = performance
    take = record(rig, attachment, takes[0][::30], torch.Generator().manual_seed(0), StageFlaws(missing=0.05)).take
    phase = torch.linspace(0, 6, len(take))
    turned = rotation_matrix(torch.stack([0 * phase, 0.7 * phase.sin(), 0 * phase], 1))
    walked = 300 * torch.stack([phase.sin(), 0 * phase, phase.cos()], 1)
    values = take.markers.values @ turned.transpose(1, 2) + walked[:, None]
    free = moved(replace(take, markers=Track(take.markers.names, values)), stage_space)
    assert abs(float(align_take(rig, attachment, free).scale[0] * stage_space.scale) - 1) < 0.01


def test_what_is_left_at_rest_is_told_and_subtracted(performance: Performance) -> None:
    rig, attachment, takes = performance
    take = record(rig, attachment, takes[0][::5], torch.Generator().manual_seed(0)).take
    generator = torch.Generator().manual_seed(1)
    shift = 3 * torch.randn(100, 3, generator=generator)
    shifted = replace(take, markers=Track(take.markers.names, take.markers.values + shift))

    def error(sites: Attachment) -> float:
        solved = MarkerSolver(rig, sites).solve_take(shifted).weights
        return float((solved.values[..., 0] - takes[0][::5]).abs().mean())

    once, often = (rest_residual(rig, attachment, shifted, iterations=count) for count in (1, 4))
    # Most of the shift is seen as such; the part that expressions can imitate is not.
    assert float((often.residual - shift).norm()) < 0.7 * float(shift.norm())
    assert error(often) < error(once) < 0.9 * error(attachment)
    # A take that lies on its sites has nothing to subtract.
    clean = rest_residual(rig, attachment, take).residual
    assert float(clean.norm(dim=1).mean()) < 0.15


def flipped(take: Take, axis: int) -> Take:
    values = take.markers.values.clone()
    values[..., axis] *= -1
    return replace(take, markers=Track(take.markers.names, values))


@pytest.mark.parametrize(("axis", "neutral_frame"), [(0, None), (1, 0), (2, 0)])
def test_a_mirrored_take_is_refused_with_both_distances(
    performance: Performance, stage_space: Similarity, axis: int, neutral_frame: int | None
) -> None:
    rig, attachment, takes = performance
    take = record(rig, attachment, takes[0][::90], torch.Generator().manual_seed(0)).take
    mirrored = flipped(moved(take, stage_space), axis)
    with pytest.raises(AlignmentError, match=r"mirror image.* scaled 3\d\.\d mm .* mirrored as well \S+ mm .*--flip x"):
        align_take(rig, attachment, mirrored, neutral_frame)
    with pytest.raises(AlignmentError, match="mirror image"):
        fit_attachment(rig, mirrored, attachment)
    # Negated again, or insisted on, it is aligned to the rig; its true scale is 1 / 1.07.
    right = align_take(rig, attachment, flipped(mirrored, axis), 0)
    assert abs(float(right.scale[0]) * 1.07 - 1) < 0.03
    assert float(align_take(rig, attachment, mirrored, 0, insist=True).scale[0]) * 1.07 < 0.9


def swapped(take: Take, pair: tuple[int, int], share: float) -> Take:
    """Two labels exchanged in a share of the frames, in the middle of the take."""
    values, frames = take.markers.values.clone(), len(take)
    rows = slice(int(frames * (1 - share) / 2), int(frames * (1 + share) / 2))
    values[rows, list(pair)] = values[rows, list(pair[::-1])]
    return replace(take, markers=Track(take.markers.names, values))


@pytest.mark.parametrize(
    ("pair", "share", "neutral_frame"),
    [
        ((3, 41), 0.4, None),
        *(
            pytest.param(pair, share, frame, marks=pytest.mark.bench)
            for pair, share, frame in (
                ((0, 60), 0.09, None),
                ((7, 90), 0.09, None),
                ((7, 90), 0.4, None),
                ((0, 60), 0.4, None),
            )
        ),
        *((pair, 0.4, 40) for pair in ((0, 60), (3, 41), (7, 90))),
    ],
)
def test_exchanged_labels_do_not_move_the_alignment(
    performance: Performance, stage_space: Similarity, pair: tuple[int, int], share: float, neutral_frame: int | None
) -> None:
    rig, attachment, takes = performance
    weights = takes[0][:1200:15].clone()
    weights[40] = 0
    take = record(rig, attachment, weights, torch.Generator().manual_seed(pair[0]), StageFlaws(missing=0.02)).take
    at_rest = attachment.on(rig.neutral.faces, rig.vertices)
    for free, space in ((True, stage_space), (False, replace(stage_space, scale=torch.ones(1)))):
        clean = moved(take, space)
        dirty = swapped(clean, pair, share)
        right, found = (align_take(rig, attachment, each, neutral_frame, scale=free) for each in (clean, dirty))
        assert off_by(right.inverse(), found, at_rest) < 0.3
        assert abs(float(found.scale[0]) * float(space.scale) - 1) < (5e-3 if free else 1e-12)


@pytest.mark.real
@pytest.mark.parametrize("count", [12, 100])
def test_no_real_take_is_called_mirrored_and_each_is_when_it_is(
    real_capture: Performance, stage_space: Similarity, count: int
) -> None:
    rig, attachment, takes = real_capture
    sites = attachment.select((attachment.labels or ())[:count])
    rest = sites.on(rig.neutral.faces, rig.vertices)
    for weights in takes:
        take = record(rig, sites, weights[::40], torch.Generator().manual_seed(0)).take
        take = moved(take, stage_space)
        right = check_mirrored(take.markers.values.nanmean(0), rest)
        assert not right.mirrored
        assert right.mirrored_distance > 5 * right.distance
        assert check_mirrored(flipped(take, 0).markers.values.nanmean(0), rest).mirrored
