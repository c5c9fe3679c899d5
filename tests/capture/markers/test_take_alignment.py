"""A take is laid on the rig, whether it holds a neutral frame or not."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Take, Track
from torchface.capture import MarkerSolver, align_take, rest_residual
from torchface.geometry.similarity import Similarity
from torchface.synthetic.stages.marker_stage import StageFlaws, record

Performance = tuple[BlendshapeRig, Attachment, list[Tensor]]


def moved(take: Take, space: Similarity) -> Take:
    assert take.markers is not None
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
    weights = takes[0].clone()
    weights[:, rig.index(["browInnerUp", "mouthSmileLeft", "mouthSmileRight"])] += 0.3
    weights = weights.clamp(0, 1)
    take = record(rig, attachment, weights, torch.Generator().manual_seed(0), StageFlaws(missing=0.05)).take
    found = align_take(rig, attachment, moved(take, stage_space))
    assert off_by(found, stage_space, attachment.on(rig.neutral.faces, rig.vertices)) < 1.0
    # The similarity goes to the solver, which then reads the take in its own space.
    solver = MarkerSolver(rig, attachment, found)
    solved = solver.solve_take(moved(take, stage_space)).weights
    best = MarkerSolver(rig, attachment).solve_take(take).weights
    assert solved is not None
    assert best is not None
    error, least = ((w.values[..., 0] - weights).abs().mean() for w in (solved, best))
    assert error < 1.25 * least


def test_what_is_left_at_rest_is_told_and_subtracted(performance: Performance) -> None:
    rig, attachment, takes = performance
    take = record(rig, attachment, takes[0][::5], torch.Generator().manual_seed(0)).take
    generator = torch.Generator().manual_seed(1)
    shift = 3 * torch.randn(100, 3, generator=generator)
    assert take.markers is not None
    shifted = replace(take, markers=Track(take.markers.names, take.markers.values + shift))

    def error(sites: Attachment) -> float:
        solved = MarkerSolver(rig, sites).solve_take(shifted).weights
        assert solved is not None
        return float((solved.values[..., 0] - takes[0][::5]).abs().mean())

    once, often = (rest_residual(rig, attachment, shifted, iterations=count) for count in (1, 4))
    assert often.residual is not None
    # Most of the shift is seen as such; the part that expressions can imitate is not.
    assert float((often.residual - shift).norm()) < 0.7 * float(shift.norm())
    assert error(often) < error(once) < 0.9 * error(attachment)
    # A take that lies on its sites has nothing to subtract.
    clean = rest_residual(rig, attachment, take).residual
    assert clean is not None
    assert float(clean.norm(dim=1).mean()) < 0.15
