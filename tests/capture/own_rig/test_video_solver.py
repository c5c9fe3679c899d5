"""The video solve recovers what was planted: weights, poses, gradients; and bridges what it does not see."""

import functools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from planted.gaussian_density import gaussian
from torchface import BlendshapeRig, Corrective, Correctives
from torchface.capture import DynamicsPrior, ShapePrior, VideoSolver
from torchface.capture.own_rig import FaceMeasurements, VideoSettings, solve_whole_take
from torchface.capture.own_rig.face_points import FacePoints
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.synthetic import performer
from torchface.synthetic.stages import perform

K = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)
UPRIGHT = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
SEEN = ("jawOpen", "mouthPucker", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "eyeBlinkLeft", "mouthLeft")


@functools.cache
def whole_rig() -> BlendshapeRig:
    return performer(texture=False)


@pytest.fixture(scope="module")
def small() -> BlendshapeRig:
    """The performer with a few shapes that landmarks show well."""
    return whole_rig().select(SEEN)


class Walk(torch.nn.Module):
    """Weights stay where they are, give or take a little: a dynamics prior that needs no learning."""

    window = 1

    def __init__(self, deviation: float = 0.03) -> None:
        super().__init__()
        self.register_buffer("center", torch.zeros(len(SEEN), dtype=torch.float64))
        self.variance = deviation**2

    def require(self, names: tuple[str, ...]) -> None:
        assert names == SEEN

    def forward(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        # A part that depends on the window, so that derivatives have something to go through.
        return 0.999 * windows[:, -1], self.variance * (1 + windows[:, -1].square())


def poses(frames: int, away: float = 480.0) -> tuple[Tensor, Tensor]:
    at = torch.linspace(0, 1, frames, dtype=torch.float64)[:, None]
    turn = torch.cat([0.1 * torch.sin(3 * at), 0.25 * torch.cos(2 * at), 0.05 * at], dim=1)
    shift = torch.cat([10 * at, -5 * at, away + 10 * at], dim=1)
    return UPRIGHT @ rotation_matrix(turn), shift


def acted(frames: int, shapes: int = len(SEEN)) -> Tensor:
    at = torch.linspace(0, 1, frames, dtype=torch.float64)[:, None]
    phase = torch.arange(shapes, dtype=torch.float64)
    return (0.45 + 0.45 * torch.sin(2 * at + phase)).clamp(0, 1)


def film(rig: BlendshapeRig, weights: Tensor, rotation: Tensor, translation: Tensor, noise: float = 0.0) -> Tensor:
    points = FacePoints.of(rig, rig.neutral.landmarks)
    rows = points.chosen(weights, rotation, translation, K)
    placed = points.at(weights)[torch.arange(len(rows))[:, None], rows]
    image = (placed @ rotation.mT + translation[:, None]) @ K.T
    pixels = image[..., :2] / image[..., 2:]
    generator = torch.Generator().manual_seed(1)
    return pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)


def exact(rig: BlendshapeRig, **settings: float) -> VideoSolver:
    exactly = VideoSettings(sparsity=0.0, ridge=1e-9, pixel_noise=0.01, tolerance=1e-9, steps=500, **settings)
    return VideoSolver(rig, None, K, settings=exactly)


def test_exact_landmarks_give_exact_weights_and_poses(small: BlendshapeRig) -> None:
    rotation, translation = poses(5)
    weights = acted(5)
    solution = exact(small)(film(small, weights, rotation, translation))
    torch.testing.assert_close(solution.weights, weights, atol=1e-4, rtol=0)
    torch.testing.assert_close(solution.rotation, rotation, atol=1e-4, rtol=0)
    torch.testing.assert_close(solution.translation, translation, atol=0.05, rtol=0)
    assert float(solution.errors.max()) < 1e-3
    assert bool(solution.solved.all())


def test_errors_along_the_contour_count_as_in_the_solve(small: BlendshapeRig) -> None:
    """An annotator's place along the contour says nothing of a face: 0.3 of it counts, of what lies across all."""
    rotation, translation = poses(2)
    weights = acted(2)
    seen, solver = film(small, weights, rotation, translation), exact(small)
    along = torch.nn.functional.normalize(seen[:, 6] - seen[:, 4], dim=-1)
    for way, counted in ((along, 0.3), (along.flip(-1) * along.new_tensor([-1.0, 1.0]), 1.0)):
        moved = seen.clone()
        moved[:, 5] += 10 * way
        errors = solver.reprojection_errors(moved, weights, rotation, translation)
        torch.testing.assert_close(errors, torch.full_like(errors, counted * 10 / 68**0.5), atol=1e-3, rtol=0)


def test_a_landmark_counts_in_the_error_as_much_as_it_is_trusted(small: BlendshapeRig) -> None:
    """One behind a hand lies anywhere."""
    rotation, translation = poses(2)
    weights = acted(2)
    moved, solver = film(small, weights, rotation, translation), exact(small)
    moved[:, 30] += torch.tensor([6.0, 8.0])
    for trust in (1.0, 0.1, 0.0):
        confidence = torch.ones(2, 68)
        confidence[:, 30] = trust
        errors = solver.reprojection_errors(moved, weights, rotation, translation, confidence)
        expected = 10 * (trust / (67 + trust)) ** 0.5
        torch.testing.assert_close(errors, torch.full_like(errors, expected), atol=1e-3, rtol=0)


def test_landmarks_that_are_not_seen_are_skipped(small: BlendshapeRig) -> None:
    rotation, translation = poses(3)
    weights = acted(3)
    found = film(small, weights, rotation, translation)
    found[:, [3, 20, 40, 62]] = torch.nan
    found[1, :17] = torch.nan
    torch.testing.assert_close(exact(small)(found).weights, weights, atol=1e-3, rtol=0)
    wrong = film(small, weights, rotation, translation)
    wrong[:, 48] += 50.0
    trust = torch.ones(3, 68)
    trust[:, 48] = 0
    torch.testing.assert_close(exact(small)(wrong, confidence=trust).weights, weights, atol=1e-3, rtol=0)


@settings(max_examples=5)
@given(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-0.3, 0.3))
def test_turning_head_and_camera_alike_leaves_the_weights(pitch: float, yaw: float, roll: float) -> None:
    """A rig that lies turned in its own space is seen the same."""
    rig = whole_rig().select(SEEN)
    turn = rotation_matrix(torch.tensor([[pitch, yaw, roll]], dtype=torch.float64))[0]
    turned = BlendshapeRig(
        rig.neutral.with_vertices(rig.vertices @ turn.T.float()), rig.deltas @ turn.T.float(), rig.names
    )
    found = film(rig, acted(1), *poses(1), noise=1.0)
    settings = VideoSettings(contour_slide=1.0, tolerance=1e-7, steps=500)
    one, other = (VideoSolver(r, None, K, settings=settings)(found) for r in (rig, turned))
    torch.testing.assert_close(one.weights, other.weights, atol=1e-3, rtol=0)
    torch.testing.assert_close(one.rotation, other.rotation @ turn, atol=1e-3, rtol=0)


@pytest.mark.parametrize("remembers", [False, True])
def test_derivatives_are_finite_differences(small: BlendshapeRig, remembers: bool) -> None:
    """Through all frames: what the filter carries from one to the next is differentiated too."""
    rotation, translation = (pose[:2] for pose in poses(60))
    found = film(small, acted(60)[:2], rotation, translation, noise=1.0)
    prior = ShapePrior.fit([acted(40)], SEEN)
    settings = VideoSettings(relative_noise=0.01, tolerance=1e-11, steps=500)
    solver = VideoSolver(small, None, K, prior, Walk() if remembers else None, settings)
    factor = torch.randn(2, len(SEEN), generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def value(landmarks: Tensor) -> Tensor:
        solution = solver(landmarks, rotation, translation)
        return (solution.weights * factor).sum() + solution.translation.sum()

    probe = found.clone().requires_grad_()
    value(probe).backward()
    way = torch.randn(found.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    step = 1e-5
    difference = (value(found + step * way) - value(found - step * way)) / (2 * step)
    torch.testing.assert_close((probe.grad * way).sum(), difference, rtol=1e-4, atol=1e-6)


@pytest.fixture(scope="module")
def corrective(small: BlendshapeRig) -> BlendshapeRig:
    definitions = (
        Corrective("open_smile", ("jawOpen", "mouthSmileLeft")),
        Corrective("open_pucker_left", ("jawOpen", "mouthPucker", "mouthLeft")),
        Corrective("blink_half", ("eyeBlinkLeft",), 0.5),
    )
    smile, pucker, blink = small.deltas[small.index(["mouthSmileLeft", "mouthPucker", "eyeBlinkLeft"])]
    deltas = torch.stack([0.4 * smile.roll(1, 1), 0.5 * pucker.roll(2, 1), 0.3 * blink.roll(1, 1)])
    return BlendshapeRig(small.neutral, small.deltas, small.names, Correctives(deltas, definitions))


def test_correctives_are_solved_with(corrective: BlendshapeRig, small: BlendshapeRig) -> None:
    rotation, translation = poses(2)
    weights = acted(2)
    marks = corrective.neutral.landmarks
    points = FacePoints.of(corrective, marks)
    torch.testing.assert_close(points.at(weights)[:, :68], corrective.double()(weights)[:, marks], atol=1e-5, rtol=0)
    seen = film(corrective.float(), weights, rotation, translation)
    solution = exact(corrective)(seen)
    torch.testing.assert_close(solution.weights, weights, atol=1e-3, rtol=0)
    assert (exact(small)(seen).weights - weights).abs().max() > 0.1
    again = VideoSolver.from_config(exact(corrective).config)
    again.load_state_dict(exact(corrective).state_dict())
    torch.testing.assert_close(again(seen).weights, solution.weights)


def test_derivatives_with_correctives_are_finite_differences(corrective: BlendshapeRig) -> None:
    rotation, translation = (pose[:1] for pose in poses(60))
    found = film(corrective, acted(60)[:1], rotation, translation, noise=1.0)
    solver = VideoSolver(corrective, None, K, settings=VideoSettings(tolerance=1e-11, steps=500))
    probe = found.clone().requires_grad_()
    solver(probe, rotation, translation).weights.square().sum().backward()
    way = 1e-5 * torch.randn(found.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    after, before = (solver(found + step, rotation, translation).weights.square().sum() for step in (way, -way))
    torch.testing.assert_close((probe.grad * way).sum(), (after - before) / 2, rtol=1e-3, atol=1e-9)


def test_frame_by_frame_is_the_batch(small: BlendshapeRig) -> None:
    found = film(small, acted(6), *poses(6), noise=1.0)
    solver = VideoSolver(small, None, K, dynamics=Walk())
    together = solver(found)
    state = solver.start()
    for t, marks in enumerate(found):
        state = solver.step(state, marks)
        assert torch.equal(state.weights, together.weights[t])
        assert torch.equal(state.rotation, together.rotation[t])
    # What comes later changes nothing before it.
    assert torch.equal(solver(found[:3]).weights, together.weights[:3])


def test_memory_beats_single_frames_and_all_frames_beat_memory(small: BlendshapeRig) -> None:
    weights = acted(60)
    found = film(small, weights, *poses(60), noise=2.0)
    alone = VideoSolver(small, None, K, settings=VideoSettings(pixel_noise=2.0))
    solver = VideoSolver(small, None, K, None, Walk(), VideoSettings(pixel_noise=2.0))
    errors = [float((w - weights)[10:].square().mean().sqrt()) for w in (alone(found).weights, solver(found).weights)]
    errors.append(float((solve_whole_take(solver, found).weights - weights)[10:].square().mean().sqrt()))
    assert errors[1] < 0.72 * errors[0]
    assert errors[2] < 0.9 * errors[1]


def test_frames_without_a_face_are_bridged(small: BlendshapeRig) -> None:
    weights = acted(30)
    found = film(small, weights, *poses(30), noise=0.5)
    found[:2] = torch.nan
    found[12:16] = torch.nan
    found[20, 5:] = torch.nan  # five are too few
    solver = VideoSolver(small, None, K, dynamics=Walk())
    for solution in (solver(found), solve_whole_take(solver, found)):
        assert solution.solved.tolist() == [t not in (0, 1, 12, 13, 14, 15, 20) for t in range(30)]
        assert bool(torch.isfinite(solution.weights).all() & torch.isfinite(solution.rotation).all())
        assert torch.equal(solution.weights[0], solution.weights[2])
        assert float((solution.weights[16:] - weights[16:]).abs().max()) < 0.2
    causal, whole = solver(found), solve_whole_take(solver, found)
    gap = slice(12, 16)
    assert torch.equal(causal.weights[gap], causal.weights[11:12].expand(4, -1))
    ends = whole.weights[[11, 16]]
    between = torch.lerp(ends[:1], ends[1:], torch.arange(1, 5).to(ends)[:, None] / 5)
    torch.testing.assert_close(whole.weights[gap], between)
    assert (whole.weights - weights)[gap].abs().mean() < (causal.weights - weights)[gap].abs().mean()


def test_antagonists_change_sides_during_a_take() -> None:
    """Also where weights are expected near those of the frame before, which were of the other side."""
    rig = whole_rig().select([*SEEN, "mouthRight"])
    rotation, translation = poses(25)
    at = torch.linspace(-0.7, 0.7, 25).double()
    true = torch.zeros(25, len(rig.names)).double()
    true[:, rig.names.index("mouthLeft")], true[:, rig.names.index("mouthRight")] = at.clamp(min=0), (-at).clamp(min=0)
    solver = VideoSolver(rig, None, K, settings=VideoSettings(sparsity=0.0, pixel_noise=0.5, motion=2.0))
    solved = solver(film(rig, true, rotation, translation, 0.2)).weights
    left, right = (solved[:, rig.names.index(name)] for name in ("mouthLeft", "mouthRight"))
    assert float(torch.minimum(left, right).max()) == 0
    assert float((left - right - at).abs().max()) < 0.12


def test_a_head_does_not_jump_where_half_of_its_landmarks_are_hidden(small: BlendshapeRig) -> None:
    """A hand before nose, mouth and chin leaves brows and eyes, from which a far head's distance is hardly seen."""
    rotation, translation = (x.expand(12, *x.shape[1:]) for x in poses(1, 1300.0))
    found = film(small, acted(1).expand(12, -1), rotation, translation, noise=0.4)
    hidden = [*range(4, 17), *range(27, 36), *range(48, 68)]
    found[6] = 11 * found[6] - 10 * found[5]  # of all of a face behind a hand networks are less sure
    sure, off = torch.ones(12, 68), torch.full((12, 68), 0.4)
    sure[6, hidden], off[6] = 0.02, 4.0
    solver = VideoSolver(small, None, K, settings=VideoSettings.of_found_landmarks())
    moved = solver(found, confidence=sure, measured=FaceMeasurements(off)).translation
    assert float(moved.diff(dim=0).norm(dim=1).max()) < 25


def test_landmarks_that_are_not_trusted_are_no_face(small: BlendshapeRig) -> None:
    """A filter carries landmarks on for some frames after a face was lost, when nothing is sure of them."""
    found = film(small, acted(8), *poses(8))
    sure = torch.ones(8, 68)
    sure[3:6] = 0.0
    solver = VideoSolver(small, None, K)
    carried = solver(found, confidence=sure)
    found[3:6] = torch.nan
    lost = solver(found)
    assert carried.solved.tolist() == lost.solved.tolist() == [t not in (3, 4, 5) for t in range(8)]
    torch.testing.assert_close(carried.weights, lost.weights)


def test_landmarks_in_one_place_or_on_a_line_are_no_face(small: BlendshapeRig) -> None:
    solver = exact(small)
    landmarks = film(small, acted(5), *poses(5))
    line = torch.stack([torch.arange(68.0), torch.arange(68.0) / 3 + 50], 1)
    lost = landmarks.clone()
    lost[2] = torch.nan
    expected = solver(lost)
    for marks in (torch.zeros(68, 2), torch.full((68, 2), 123.4), line):
        lost[2] = marks
        found = solver(lost)
        assert found.solved.tolist() == [True, True, False, True, True]
        for name in ("weights", "rotation", "translation"):
            torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=0, atol=1e-6)


def test_a_strong_prior_has_its_way(small: BlendshapeRig) -> None:
    """The more a prior counts, the closer to its peak; where it counts for nothing, it changes nothing."""
    samples = 0.3 + 0.02 * torch.randn(200, len(SEEN), generator=torch.Generator().manual_seed(0))
    found = film(small, acted(1), *poses(1), noise=1.0)
    density = gaussian(samples)
    weak, strong = (ShapePrior(SEEN, [range(len(SEEN))], [density], strength) for strength in (0.0, 1e7))
    peak = VideoSolver(small, None, K, strong)(found).weights
    torch.testing.assert_close(peak[0], samples.mean(0).double(), atol=2e-3, rtol=0)
    without = VideoSolver(small, None, K)(found).weights
    torch.testing.assert_close(VideoSolver(small, None, K, weak)(found).weights, without, atol=1e-6, rtol=0)


def test_a_wrong_pose_is_refined_unless_it_is_trusted(small: BlendshapeRig) -> None:
    rotation, translation = poses(1)
    weights = acted(1)
    found = film(small, weights, rotation, translation)
    wrong = rotation_matrix(torch.tensor([[0.0, 0.06, 0.0]], dtype=torch.float64)) @ rotation
    refined = exact(small)(found, wrong, translation)
    torch.testing.assert_close(refined.weights, weights, atol=1e-3, rtol=0)
    trusted = exact(small, pose_trust=1e4)(found, wrong, translation)
    torch.testing.assert_close(trusted.rotation, wrong, atol=1e-3, rtol=0)


def test_learned_dynamics_are_used(small: BlendshapeRig) -> None:
    pytest.importorskip("gpytorch")
    from torchface.capture.priors import DynamicsSettings

    quick = DynamicsSettings(inducing=10, subset=60, iterations=3)
    dynamics = DynamicsPrior.fit([acted(90), acted(70).flip(0)], SEEN, window=3, settings=quick)
    found = film(small, acted(12), *poses(12), noise=1.0)
    with_it, without = (VideoSolver(small, None, K, dynamics=d)(found).weights for d in (dynamics, None))
    assert with_it.diff(dim=0).diff(dim=0).abs().mean() < 0.7 * without.diff(dim=0).diff(dim=0).abs().mean()


def test_performed_weights_come_back_through_a_prior_that_knows_them() -> None:
    rig = whole_rig()
    generator = torch.Generator().manual_seed(0)
    track = perform(400, generator).weights
    take = rig.weights_from(track)
    prior = ShapePrior.fit([take], rig.names)
    weights = take[40::60].double()
    found = film(rig, weights, *poses(len(weights)), noise=1.0)
    off = [(VideoSolver(rig, None, K, p)(found).weights - weights).abs().mean() for p in (None, prior)]
    assert off[1] < 0.6 * off[0]


def test_bad_input(small: BlendshapeRig) -> None:
    found = film(small, acted(2), *poses(2))
    solver = VideoSolver(small, None, K)
    with pytest.raises(NameMismatchError, match="learned for other shapes"):
        VideoSolver(small, None, K, ShapePrior.fit([acted(20, 3)], ("a", "b", "c")))
    few = found.clone()
    few[:, 5:] = torch.nan
    with pytest.raises(ValueRangeError, match="at most 5 that are trusted in any of 2 frames"):
        solver(few)
    with pytest.raises(ValueRangeError, match="found 5 in the first frame"):
        solver.step(solver.start(), few[0])
    with pytest.raises(ShapeError, match=r"landmarks: found \(2, 67, 2\)"):
        solver(found[:, 1:])
    with pytest.raises(ValueRangeError, match="infinite"):
        solver(found / 0)
    with pytest.raises(ValueRangeError, match="confidence"):
        solver(found, confidence=torch.full((2, 68), -1.0))
    with pytest.raises(ShapeError, match="intrinsics"):
        VideoSolver(small, None, K[:2])
    with pytest.raises(ShapeError, match="landmark_vertices"):
        VideoSolver(small, torch.arange(5), K)
    with pytest.raises(ValueRangeError, match="ids below"):
        VideoSolver(small, torch.arange(68) + 10**6, K)
    with pytest.raises(ValueRangeError, match="pixel_noise"):
        VideoSettings(pixel_noise=0.0)
    with pytest.raises(ValueRangeError, match="without a dynamics prior"):
        solve_whole_take(solver, found)
    with pytest.raises(ValueRangeError, match="no frame yet"):
        _ = solver.start().weights
