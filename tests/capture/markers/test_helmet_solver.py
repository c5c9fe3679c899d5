"""A helmet that slips leaves the weights alone, and its motion is separated from them."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Take
from torchface.capture import HelmetSolver, MarkerSolver
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.synthetic.stages.marker_stage import Recording, StageFlaws, record

Performance = tuple[BlendshapeRig, Attachment, list[Tensor]]


def filmed(performance: Performance, every: int, slip: bool, take: int = 0) -> Recording:
    rig, attachment, takes = performance
    flaws = StageFlaws(slip_translation=10, slip_rotation=4) if slip else StageFlaws()
    return record(rig, attachment, takes[take][::every], torch.Generator().manual_seed(2), flaws)


def check_errors(performance: Performance, every: int = 3) -> None:
    rig, attachment, _ = performance
    steady, slipping = filmed(performance, every, False), filmed(performance, every, True)

    def error(weights: Tensor) -> float:
        return float((weights - steady.weights).abs().mean())

    def markers(recording: Recording) -> Tensor:
        return recording.take.markers.values

    alone = MarkerSolver(rig, attachment)
    least = error(alone(markers(steady)))
    assert error(alone(markers(slipping))) > 5 * least
    for exact, most in ((False, 1.25), (True, 1.06)):
        solver = HelmetSolver(rig, attachment, exact=exact)
        weights, motion = solver(markers(slipping))
        assert error(weights) <= most * least
        assert error(solver(markers(steady))[0]) <= 1.06 * least
        if exact:
            assert (motion.translation - slipping.translation).abs().mean() < 0.1
            turn = motion.rotation.transpose(1, 2) @ slipping.rotation.double()
            angle = torch.rad2deg(torch.arccos(((turn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)))
            assert angle.mean() < 0.15


def test_weights_on_the_performer_are_as_good_as_without_slip(performance: Performance) -> None:
    check_errors(performance)


@pytest.mark.real
def test_weights_on_a_real_rig_are_as_good_as_without_slip(real_capture: Performance) -> None:
    check_errors(real_capture)


def test_a_large_turn_is_found_exactly(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    generator = torch.Generator().manual_seed(0)
    weights = (2 * torch.rand(20, 12, generator=generator) - 0.7).clamp(0, 1)
    flaws = StageFlaws(noise=0, slip_translation=25, slip_rotation=20)
    recording = record(small_rig, small_attachment, weights, generator, flaws)
    solver = HelmetSolver(small_rig, small_attachment, sparsity=0, ridge=0)
    markers = recording.take.markers.values.double()
    solved, motion = solver(markers)
    torch.testing.assert_close(solved, weights.double(), rtol=0, atol=2e-2)
    torch.testing.assert_close(motion.translation, recording.translation.double(), rtol=0, atol=0.05)
    torch.testing.assert_close(motion.rotation, recording.rotation.double(), rtol=0, atol=1e-3)
    torch.testing.assert_close(motion.undo(motion.apply(markers)), markers, rtol=0, atol=1e-9)
    still = recording.markers.double()
    torch.testing.assert_close(motion.undo(markers), still, rtol=0, atol=0.2)


def test_degrees_are_the_rotation_vector(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    _, motion = HelmetSolver(small_rig, small_attachment)(
        small_attachment.on(small_rig.neutral.faces, small_rig.vertices)[None]
    )
    vector = torch.tensor([[10.0, -20, 30], [0, 0, 0], [1e-6, 0, 0]], dtype=torch.float64)
    x, y, z = torch.deg2rad(vector).unbind(1)
    zero = torch.zeros_like(x)
    turn = torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3))
    torch.testing.assert_close(replace(motion, rotation=turn).degrees(), vector, rtol=1e-9, atol=1e-12)


def test_gaps_and_another_space(performance: Performance, stage_space: Similarity) -> None:
    rig, attachment, _ = performance
    recording = filmed(performance, 60, True)
    markers = recording.take.markers.values.double()
    markers[::2, ::3] = torch.nan
    markers[5, 2:] = torch.nan  # two markers tell no motion; the frame is solved all the same
    here = HelmetSolver(rig, attachment)
    there = HelmetSolver(rig, attachment, stage_space.inverse())
    weights, motion = here(markers)
    turned, same = there(stage_space.apply(markers))
    torch.testing.assert_close(turned, weights, rtol=0, atol=1e-3)
    torch.testing.assert_close(same.translation, motion.translation, rtol=0, atol=5e-2)
    one, _ = here(markers[4:5])
    torch.testing.assert_close(one[0], weights[4], rtol=0, atol=1e-5)
    solved, _ = here.solve_take(recording.take)
    assert solved.weights.names == rig.names


def test_bad_input_says_what_is_wrong(small_rig: BlendshapeRig, small_attachment: Attachment) -> None:
    solver = HelmetSolver(small_rig, small_attachment)
    with pytest.raises(ShapeError, match=r"expected \(B,40,3\)"):
        solver(torch.zeros(2, 3, 3))
    with pytest.raises(ValueRangeError, match=r"missing in 1 of 2 frames \(1\)"):
        solver(torch.stack([torch.zeros(40, 3), torch.full((40, 3), torch.nan)]))
    with pytest.raises(NameMismatchError, match="no markers"):
        solver.solve_take(Take(60.0))
