"""Appearance models: planted shapes come back, steps are those of the plain algorithm, and a filmed performer."""

import copy
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from scipy.interpolate import RBFInterpolator
from torch import Tensor

from planted import portrait_video
from planted.portrait_video import EXPRESSIONS, PortraitVideo, expression_weights, mixed_expressions
from torchface import zoo
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.io.images.image_files import load_image
from torchface.io.landmarks.dlib_xml import load_dlib_faces
from torchface.landmarks import AppearanceModel, AppearanceSettings
from torchface.landmarks.images.appearance.appearance_level import TextureResidual, sample_pixels
from torchface.landmarks.images.appearance.shape_modes import (
    learn_shape_modes,
    planar_pose,
    procrustes_mean,
    similarity_modes,
)
from torchface.landmarks.images.ibug_68 import box_around
from torchface.synthetic import draw_identities, performer

TRAINED, TESTED = len(EXPRESSIONS), 10


@pytest.fixture(scope="module")
def film() -> PortraitVideo:
    """Fifteen frames to learn from, and ten of other mixtures of the same extremes."""
    actor = performer(draw_identities(1, torch.Generator().manual_seed(3))[0])
    generator = torch.Generator().manual_seed(3)
    poses = expression_weights(actor.names, list(EXPRESSIONS.values()))
    mixed = mixed_expressions(actor.names, TESTED, generator)
    return portrait_video.render_portrait_video(actor, torch.cat([poses, mixed]), generator)


@pytest.fixture(scope="module")
def model(film: PortraitVideo) -> AppearanceModel:
    return AppearanceModel.fit(list(film.frames[:TRAINED]), film.landmarks[:TRAINED])


def test_a_state_that_changes_takes_effect(film: PortraitVideo, model: AppearanceModel) -> None:
    """What is prepared of it follows, whichever way it was changed; a copy is on its own."""
    shown, start = images(film)[:2], half_neutral(film)[:2]
    before = model(shown, start)
    changed = copy.deepcopy(model)
    assert torch.equal(changed(shown, start), before)
    changed.levels[0].slope.data.mul_(0.5)  # no version counter moves
    changed.mean_shape.data.copy_(changed.mean_shape.flip(1).roll(1, 1) * torch.tensor([1.02, 0.98]))
    after = changed(shown, start)
    assert float((after - before).abs().max()) > 0.05
    fresh = AppearanceModel.from_config(model.config)
    fresh.load_state_dict(changed.state_dict())
    torch.testing.assert_close(fresh(shown, start), after)
    changed.load_state_dict(model.state_dict())
    torch.testing.assert_close(changed(shown, start), before)
    assert torch.equal(model(shown, start), before)


def eyes_apart(landmarks: Tensor) -> Tensor:
    return (landmarks[:, 36] - landmarks[:, 45]).norm(dim=-1)


def half_neutral(film: PortraitVideo, seed: int = 0) -> Tensor:
    """What a detector says that hardly knows extreme faces: half of the way to the face at rest, and off besides."""
    generator = torch.Generator().manual_seed(seed)
    truth, rest = film.landmarks[TRAINED:], film.landmarks[0] - film.landmarks[0].mean(0)
    drawn = 0.5 * truth + 0.5 * planar_pose(rest, truth).apply(rest)
    unit = eyes_apart(truth)[:, None, None]
    shift = 0.03 * torch.randn(len(truth), 1, 2, generator=generator)
    return drawn + unit * (shift + 0.02 * torch.randn(truth.shape, generator=generator))


def images(film: PortraitVideo, rows: slice = slice(TRAINED, None)) -> Tensor:
    return film.frames[rows, None].float() / 255


def mean_error(found: Tensor, truth: Tensor) -> Tensor:
    return (found - truth).norm(dim=2).mean(1) / eyes_apart(truth)


def test_extreme_faces_are_found_from_a_start_that_leans_to_rest(film: PortraitVideo, model: AppearanceModel) -> None:
    truth, start = film.landmarks[TRAINED:], half_neutral(film)
    before = mean_error(start, truth)
    assert before.mean() > 0.05
    fit = model.refine(images(film), start)
    after = mean_error(fit.landmarks, truth)
    assert after.mean() < 0.25 * before.mean()
    assert (after < 0.6 * before).all()
    assert (fit.error < fit.initial_error).all()


def test_extreme_faces_have_at_most_six_tenths_of_the_trees_error(film: PortraitVideo, model: AppearanceModel) -> None:
    truth = film.landmarks[TRAINED:]
    trees = zoo.get_model("face_landmarks")
    with torch.no_grad():
        start = trees(images(film), box_around(truth))
    fit = model.refine(images(film), start)
    assert mean_error(fit.landmarks, truth).mean() <= 0.6 * mean_error(start, truth).mean()


def test_the_error_tells_a_good_fit_from_a_bad_one(film: PortraitVideo, model: AppearanceModel) -> None:
    truth = film.landmarks[TRAINED:]
    good = model.error(images(film), truth)
    assert 0.3 < good.mean() < 2.0  # new faces of the same person are as far from the model as left-out ones were
    for amount in (0.1, 0.25):
        astray = truth + amount * eyes_apart(truth)[:, None, None]
        assert (model.error(images(film), astray) > 1.3 * good).all()


def test_faces_of_a_batch_are_fitted_as_each_alone(film: PortraitVideo, model: AppearanceModel) -> None:
    start, pictures = half_neutral(film)[:3], images(film)[:3]
    start[2] = 3 * start[2]  # a face elsewhere and three times as large: other samples a pixel
    together = model.refine(pictures, start)
    for i in range(3):
        alone = model.refine(pictures[i : i + 1], start[i : i + 1])
        torch.testing.assert_close(alone.landmarks[0], together.landmarks[i], atol=0.05, rtol=0)
        torch.testing.assert_close(alone.error[0], together.error[i], rtol=1e-2, atol=0)


def test_a_larger_turned_picture_has_its_landmarks_where_they_were(film: PortraitVideo, model: AppearanceModel) -> None:
    """Twice the pixels and upside down: the similarity belongs to the pose, not to the face."""
    pictures, start = images(film)[:4], half_neutral(film)[:4]
    found = model(pictures, start)
    turned = torch.nn.functional.interpolate(pictures, scale_factor=2.0, mode="bilinear").flip(2, 3)
    size = torch.tensor([turned.shape[3], turned.shape[2]])
    again = model(turned, size - 1 - (2 * start + 0.5))
    apart = ((size - 1 - again - 0.5) / 2 - found).norm(dim=2)
    assert apart.mean() < 0.15  # along the jaw, where nothing holds a landmark, single ones slide further


def test_colour_and_light_do_not_matter(film: PortraitVideo, model: AppearanceModel) -> None:
    pictures, start = images(film)[:4], half_neutral(film)[:4]
    found = model(pictures, start)
    ramp = torch.linspace(0.55, 0.95, pictures.shape[3])
    lit = model((0.02 + pictures * ramp).expand(-1, 3, -1, -1), start)
    assert (lit - found).norm(dim=2).mean() < 0.01 * eyes_apart(start).mean()


@pytest.fixture(scope="module")
def planted(film: PortraitVideo) -> tuple[list[Tensor], Tensor, Tensor]:
    """One picture bent in two smooth ways by thin plates, which know nothing of triangles.

    Gives pictures, landmarks, and landmarks without the bending.
    """
    generator = torch.Generator().manual_seed(5)
    rest, picture = film.landmarks[1].double(), film.frames[1].float() / 255
    unit = rest - rest.mean(0)
    unit = unit / unit.square().sum(1).mean().sqrt()
    ways = 5.0 * torch.stack([
        torch.stack([unit[:, 1] * unit[:, 0], (2 * unit[:, 0]).sin()], dim=1),
        torch.stack([(2 * unit[:, 1]).cos(), unit[:, 1] ** 2 - 0.5 * unit[:, 0]], dim=1),
    ])  # fmt: skip
    amounts = torch.rand(16, 2, generator=generator, dtype=torch.float64) * 2 - 1
    moved = rest + torch.einsum("mk,klc->mlc", amounts, ways)
    height, width = picture.shape
    grid = torch.stack(torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy"), -1).reshape(-1, 2)
    pictures = []
    for shape in moved:  # a plate each
        coarse = grid.view(height, width, 2)[::4, ::4].reshape(-1, 2).double()
        field = RBFInterpolator(shape.numpy(), (rest - shape).numpy(), kernel="thin_plate_spline")(coarse.numpy())
        rows, columns = len(range(0, height, 4)), len(range(0, width, 4))
        fine = sample_pixels(torch.from_numpy(field).T.reshape(1, 2, rows, columns).float(), grid[None] / 4.0)
        source = grid + fine[0].T
        pictures.append(sample_pixels(picture[None, None], source[None])[0, 0].view(height, width))
    return pictures, moved.float(), rest.float()


@pytest.mark.parametrize("features", ["grey", "gradient_direction", "oriented_gradients"])
def test_planted_shapes_come_back_to_half_a_pixel(planted, features) -> None:
    pictures, truth, rest = planted
    settings = AppearanceSettings(features=features, reach=1e6, flexibility=0.0)
    model = AppearanceModel.fit(pictures[:12], truth[:12], settings)
    assert len(model.deviations) == 2  # as many as were planted
    start = rest + torch.tensor([2.0, -1.5])
    before = (start - truth[12:]).norm(dim=2).mean(1)
    found = model(torch.stack(pictures[12:])[:, None], start.expand(4, -1, -1))
    after = (found - truth[12:]).norm(dim=2).mean(1)
    assert before.mean() > 3.0
    assert after.max() < 0.5


def joint_step(level, residual: TextureResidual, at: Tensor, state: Tensor, precision: Tensor) -> Tensor:
    """Plain simultaneous inverse compositional: shape and appearance in one system of normal equations."""
    jacobian = level.jacobian(at)[0].flatten(0, 1)
    modes = level.modes.flatten(1).T
    whole = torch.cat([jacobian, modes], dim=1) / level.noise.sqrt()
    target = residual.left[0].flatten() + modes @ residual.coefficients[0]  # what the mean texture leaves
    prior = torch.diag(torch.cat([precision, precision.new_zeros(modes.shape[1])]))
    pull = torch.cat([precision * state[0], precision.new_zeros(modes.shape[1])])
    normal = whole.T @ whole + prior
    kept = torch.cat([torch.ones(len(precision)), (modes.norm(dim=0) > 0)]).bool()
    rest = torch.linalg.solve(normal[kept][:, kept], (whole.T @ target / level.noise.sqrt() + pull)[kept])
    return rest[: len(precision)]


def test_a_step_is_the_plain_simultaneous_algorithms_step(film: PortraitVideo, model: AppearanceModel) -> None:
    level = model.levels[0].double()
    try:
        generator = torch.Generator().manual_seed(1)
        sampled = level.mean + 0.3 * torch.randn(1, *level.mean.shape, generator=generator, dtype=torch.float64)
        state = torch.cat([torch.zeros(1, 4), 0.01 * torch.randn(1, len(model.deviations), generator=generator)], 1)
        precision = torch.cat([torch.zeros(4), model.deviations.pow(-2)]).double()
        residual = level.residual(sampled)
        fast = level.step(residual, state.double(), precision, level.curvature_terms())[0]
        plain = joint_step(level, residual, residual.coefficients, state.double(), precision)
        torch.testing.assert_close(fast, plain, rtol=2e-3, atol=2e-3 * float(plain.abs().max()))
        # The projected curvature, quadratic in the coefficients, is the one of the Jacobian itself.
        flat = level.jacobian(residual.coefficients)[0].flatten(0, 1)
        modes = level.modes.flatten(1)
        projected = flat - modes.T @ (modes @ flat)
        found = level.projected_curvature(residual.coefficients, level.curvature_terms())[0]
        torch.testing.assert_close(found, projected.T @ projected, rtol=1e-6, atol=1e-6 * float(found.abs().max()))
    finally:
        level.float()


def test_both_algorithms_end_at_the_same_place(planted) -> None:
    """Plain simultaneous steps, whose appearance is a state of its own, lead where the fast ones do."""
    pictures, truth, _ = planted
    model = AppearanceModel.fit(pictures[:12], truth[:12], AppearanceSettings(iterations=40))
    level, picture = model.levels[-1], pictures[13][None, None]
    start = truth[13:14] + torch.tensor([1.0, -0.8])
    crop = model.crop(picture, start, float(level.scale))
    fast = crop.pose.apply(model._refine_level(level, crop, crop.pose.undo(start)))
    found, at = crop.pose.undo(start), torch.zeros(1, len(level.modes))
    precision = torch.cat([torch.zeros(4), model.deviations.pow(-2)])
    for _ in range(40):
        residual = level.residual(level.sample(crop.features, model._points(found)))
        state = model._shape(found)[1]
        step = joint_step(level, residual, at, state, precision)[None]
        moved = torch.einsum("bq,qlc->blc", step, model.motions)
        linear = torch.einsum("bcnq,bq->bcn", level.jacobian(at), step)
        at = residual.coefficients - torch.einsum("bcn,kcn->bk", linear, level.modes)
        found = found - torch.einsum("blij,blj->bli", model._linear_parts(found), moved)
        found = model._landmarks(*model._shape(found))
    assert (crop.pose.apply(found) - fast).norm(dim=2).max() < 0.1
    assert (fast - truth[13]).norm(dim=2).mean() < 0.3


def test_the_jacobian_tells_how_a_texture_changes(film: PortraitVideo, model: AppearanceModel) -> None:
    """Against differences of what is sampled when the mean shape's points are moved within a training face."""
    level, truth = model.levels[-1], film.landmarks[:1]
    crop = model.crop(images(film, slice(0, 1)), truth, float(level.scale))
    found = crop.pose.undo(truth)
    jacobian = level.jacobian(level.residual(level.sample(crop.features, model._points(found))).coefficients)[0]
    for motion in (0, 1, 2, 3, 4, 5, 6):
        step = 0.4 / float(level.motion[..., motion].norm(dim=1).max())
        moved = step * model._linear_parts(found)[0] @ (model.motions[motion, :, :, None])
        ahead, behind = (
            level.sample(crop.features, model._points(found + way * moved[None, ..., 0])) for way in (1.0, -1.0)
        )
        measured = ((ahead - behind) / (2 * step))[0].flatten()
        told = jacobian[..., motion].flatten()
        assert torch.nn.functional.cosine_similarity(told, measured, dim=0) > 0.9
        assert 0.8 < float(told @ measured / measured.square().sum()) < 1.2


def test_parts_far_apart_move_apart(film: PortraitVideo) -> None:
    """Brows and chin that moved together in training need not: a mode of brows alone is within what is believed."""
    shapes = film.landmarks[:TRAINED]
    raised = torch.zeros(68, 2)
    raised[17:27, 1] = -0.1
    rigid = similarity_modes(procrustes_mean(shapes.double())[0].float()).flatten(1)
    raised = (raised.flatten() - (raised.flatten() @ rigid.T) @ rigid).view(68, 2)
    believed = []
    for reach in (0.8, 1e6):
        learned = learn_shape_modes(shapes, reach=reach, flexibility=0.0, variance_kept=0.9999)
        coefficients = torch.einsum("klc,lc->k", learned.modes, raised)
        shown = torch.einsum("k,klc->lc", coefficients, learned.modes)
        believed.append(float(shown.norm() / raised.norm()))
    assert believed[0] > 0.96 > believed[1]


@pytest.mark.parametrize(
    "break_it",
    [
        lambda model: model.levels[0].corner[3, 1].fill_(78),
        lambda model: model.deviations[0].fill_(-1.0),
        lambda model: model.levels[0].scale.fill_(1e7),
        lambda model: model.mean_shape.mul_(1e6),
    ],
)
def test_files_that_could_not_have_been_learned_are_refused(
    film: PortraitVideo, break_it: Callable[[AppearanceModel], Tensor], tmp_path: Path
) -> None:
    model = AppearanceModel.fit(list(film.frames[:4]), film.landmarks[:4])
    break_it(model)
    zoo.save_model(model, tmp_path / "actor", zoo.ModelCard("MIT", "a film", {}, "none"))
    with pytest.raises(FileFormatError, match="config and state do not fit"):
        zoo.get_model(tmp_path / "actor")


def test_a_start_beside_the_face_ends_at_something_finite(film: PortraitVideo, model: AppearanceModel) -> None:
    """Noise, black, a start half outside: whatever comes out is where a face could be, and not better by mistake."""
    start = film.landmarks[TRAINED : TRAINED + 3]
    noise = torch.rand(3, 1, 300, 240, generator=torch.Generator().manual_seed(0))
    noise[1] = 0.0
    start = start + torch.tensor([0.0, 0, 150]).view(3, 1, 1)
    fit = model.refine(noise, start)
    assert torch.isfinite(fit.landmarks).all()
    assert (fit.landmarks - start).norm(dim=2).mean(1).max() < 2 * eyes_apart(start).max()
    assert (fit.error > 2.0).all()


def test_a_face_that_is_lost_stays_lost(film: PortraitVideo, model: AppearanceModel) -> None:
    start = half_neutral(film)[:3]
    whole = model.refine(images(film)[:3], start)
    start[1, 5] = torch.nan
    fit = model.refine(images(film)[:3], start)
    assert fit.landmarks[1].isnan().all()
    assert fit.error[1] == torch.inf
    assert fit.initial_error[1] == torch.inf
    torch.testing.assert_close(fit.landmarks[[0, 2]], whole.landmarks[[0, 2]], atol=0.05, rtol=0)
    nothing = model.refine(images(film)[:1], torch.full((1, 68, 2), torch.nan))
    assert nothing.landmarks.isnan().all()


def test_floats_of_any_precision_are_taken_and_integers_refused(film: PortraitVideo, model: AppearanceModel) -> None:
    shown, start = images(film)[:1], half_neutral(film)[:1]
    wanted = model(shown, start)
    torch.testing.assert_close(model(shown.double(), start), wanted)
    torch.testing.assert_close(model.error(shown.double(), start), model.error(shown, start))
    torch.testing.assert_close(model(shown.half(), start), wanted, rtol=0, atol=0.05)
    with pytest.raises(ShapeError, match=r"images: found torch.uint8, expected floats in \[0,1\]"):
        model((255 * shown).byte(), start)


def test_bad_input_is_refused_by_name(film: PortraitVideo, model: AppearanceModel) -> None:
    frames, points = list(film.frames[:4]), film.landmarks[:4]
    holed = points.clone()
    holed[2, 40] = torch.nan
    alike = "images: found faces that all look the same"
    for error, message, pictures, marks in [
        (ShapeError, "found 2, expected at least 3", frames[:2], points[:2]),
        (ShapeError, r"found \(4, 67, 2\), expected \(4, 68, 2\)", frames, points[:, 1:]),
        (ValueRangeError, "landmarks 2: found NaN", frames, holed),
        (ValueRangeError, "landmarks 0: found some far outside", frames, points + 500),
        (ValueRangeError, "landmarks 0: found all on one line", frames, points * torch.tensor([1.0, 0.0]) + 50),
        (ValueRangeError, alike, frames[:1] * 4, points[:1].expand(4, -1, -1)),
        (ValueRangeError, alike, frames[:1] * 7, points[:1].expand(7, -1, -1)),  # a mean of seven equals is rounded
        (ShapeError, "image 1", [frames[0], frames[1][None, None], *frames[2:]], points),
    ]:
        with pytest.raises(error, match=message):
            AppearanceModel.fit(pictures, marks)
    with pytest.raises(ShapeError, match=r"initial: found \(2, 67, 2\)"):
        model(images(film)[:2], torch.zeros(2, 67, 2))
    with pytest.raises(ShapeError, match=r"expected \(B,1,H,W\) or \(B,3,H,W\)"):
        model(images(film)[:2, 0], points[:2])
    with pytest.raises(NameMismatchError, match="expected one of grey"):
        AppearanceSettings(features="sift")
    with pytest.raises(ValueRangeError, match="iterations"):
        AppearanceSettings(iterations=0)


def test_sizes_of_training_images_may_differ(film: PortraitVideo) -> None:
    frames = [frame[: 300 - 2 * i, : 240 - i] for i, frame in enumerate(film.frames[:6])]
    frames[2] = frames[2].float()[None].expand(3, -1, -1) / 255
    model = AppearanceModel.fit(frames, film.landmarks[:6])
    fit = model.refine(images(film, slice(0, 6)), film.landmarks[:6])
    assert mean_error(fit.landmarks, film.landmarks[:6]).max() < 0.02


@pytest.mark.bench
@pytest.mark.real
def test_a_dozen_photographs_help_with_faces_that_are_not_among_them(data: Path) -> None:
    """Other people, poses and cameras than learned from: no job for such a model, and yet it must help, not harm.

    What is learned, and what it is measured by, is what dlib's predictor says.
    """
    pictures, points = [], []
    for face in load_dlib_faces(next((data / "images" / "dlib_faces").glob("*.xml"))):
        box = box_around(face.points.float())
        low = (box[:2] - 0.5 * box[2:]).clamp(min=0).long()
        high = (box[:2] + 1.5 * box[2:]).long()
        whole = load_image(data / "images" / "dlib_faces" / face.image)
        pictures.append(whole[:, int(low[1]) : int(high[1]), int(low[0]) : int(high[0])])
        points.append(face.points.float() - low)
    reference = torch.stack(points)
    assert len(reference) == 18
    before, after = [], []
    generator = torch.Generator().manual_seed(0)
    for fold in range(3):
        left_out = torch.arange(len(reference)) % 3 == fold
        learned = [picture for picture, out in zip(pictures, left_out.tolist(), strict=True) if not out]
        model = AppearanceModel.fit(learned, reference[~left_out])
        for row in torch.nonzero(left_out)[:, 0].tolist():
            one = reference[row : row + 1]
            start = planar_pose(model.mean_shape, one).apply(model.mean_shape)
            start = start + 0.04 * eyes_apart(one) * torch.randn(1, 1, 2, generator=generator)
            before.append(mean_error(start, one))
            after.append(mean_error(model(pictures[row][None], start), one))
    assert torch.cat(after).mean() < 0.8 * torch.cat(before).mean()
