"""Planted heads come back from the landmarks that cameras see of them; what is no such landmark is refused."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from planted.photographed_heads import EXPRESSION, SIZE, Person, aligned_error, person, portraits
from torchface import Attachment, BlendshapeRig, zoo
from torchface.errors import ShapeError
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.geometry.cameras.pinhole import look_at
from torchface.landmarks.images.ibug_68 import as_annotated
from torchface.modeling import FitSettings, HeadModel, ImageFit, fit_images, transfer_deformation
from torchface.modeling.photographs.fit_problem import Problem
from torchface.modeling.photographs.fit_settings import SurfacePoints
from torchface.modeling.photographs.image_fit import contour_curves, smooth_differences, with_whole_eyeballs
from torchface.modeling.photographs.image_input import annotated_vertices
from torchface.modeling.photographs.landmark_view import LandmarkSites, LinearPoints
from torchface.synthetic import draw_identities, neutral_head, performer

FIXED = FitSettings(sliding=False, contour_slide=1.0, one_expression=True)


@pytest.fixture(scope="module")
def planted(rig: BlendshapeRig, model: HeadModel) -> list[tuple[Person, ImageFit]]:
    people = [person(rig, model, seed) for seed in range(4)]
    return [
        (p, fit_images(model, rig, p.landmarks, SIZE, camera=p.focal, settings=replace(FIXED, transfers=0)))
        for p in people
    ]


def test_planted_heads_come_back(planted: list[tuple[Person, ImageFit]], model: HeadModel) -> None:
    skin = model.annotations.regions["face"]
    ours = sum(aligned_error(fit.mesh.vertices[skin], p.rest[skin]) for p, fit in planted)
    mean = sum(aligned_error(model.shape.mean[skin], p.rest[skin]) for p, _ in planted)
    assert ours < 0.25 * mean
    for p, fit in planted:
        assert float(fit.coefficients.abs().max()) <= 3.0
        assert float(fit.weights.min()) >= 0.0
        assert float(fit.weights.max()) <= 1.0
        assert abs(fit.noise - 0.5) < 0.15
        assert float(fit.errors.max()) < 1.0
        for camera, truth in zip(fit.cameras, p.cameras, strict=True):
            turned = (torch.trace(camera.rotation @ truth.rotation.T) - 1) / 2
            assert math.degrees(math.acos(min(1.0, float(turned)))) < 3.0


def test_a_contour_of_fixed_points_is_not_taken_for_one_that_slides(rig: BlendshapeRig, model: HeadModel) -> None:
    """As of MediaPipe's mesh, half a pixel off in small pictures: taken for sliding, heads err by 3 mm."""
    actor = performer(draw_identities(1, torch.Generator().manual_seed(9))[0], texture=False)
    skin, size = model.annotations.regions["face"], (640, 480)
    camera = assumed_calibration(*size).intrinsics
    pixels = []
    for yaw in torch.linspace(-33, 33, 8).tolist():
        face = actor.vertices[actor.neutral.landmarks].double()
        seen = look_at(face.mean(0), yaw, 0.0, 600.0, *size)
        local = face @ seen.rotation.T + seen.translation
        pixels.append(local[:, :2] / local[:, 2:] * camera.diagonal()[:2] + camera[:2, 2])
    marks = torch.stack(pixels)
    marks = marks + 0.5 * torch.randn(marks.shape, generator=torch.Generator().manual_seed(1), dtype=marks.dtype)
    fit = fit_images(model, rig, marks.float(), size, camera=camera, settings=FitSettings(transfers=0))
    assert aligned_error(fit.mesh.vertices[skin], actor.vertices[skin]) < 1.3


def test_the_mouth_opens_as_far_as_it_is_open(planted: list[tuple[Person, ImageFit]], rig: BlendshapeRig) -> None:
    upper, lower = rig.neutral.landmarks[61:64], rig.neutral.landmarks[[67, 66, 65]]
    for p, fit in planted:
        found, true = ((v[upper] - v[lower]).norm(dim=-1) for v in (fit.posed[0].vertices, p.face))
        assert float((found - true).mean().abs()) < 0.3


def test_a_lopsided_smile_stays_lopsided(rig: BlendshapeRig, model: HeadModel) -> None:
    left, right = rig.index(["mouthSmileLeft", "mouthSmileRight"])
    weights = torch.zeros(len(rig.names))
    weights[left] = 0.7
    p = person(rig, model, 3, weights=weights)
    fit = fit_images(model, rig, p.landmarks, SIZE, camera=p.focal, settings=replace(FIXED, transfers=0))
    assert float(fit.weights[0, left] - fit.weights[0, right]) > 0.5


def test_residuals_are_what_the_cameras_see(planted: list[tuple[Person, ImageFit]], rig: BlendshapeRig) -> None:
    p, fit = planted[0]
    at = fit.posed[0].vertices[rig.neutral.landmarks].double()
    seen = torch.stack([camera.project(at) for camera in fit.cameras])
    torch.testing.assert_close(fit.residuals, seen - p.landmarks, rtol=0, atol=1e-2)


def test_covariance_tells_how_far_off_coefficients_are(rig: BlendshapeRig, model: HeadModel) -> None:
    p = person(rig, model, 5, noise=0.0)
    settings = replace(FIXED, noise=1.0)
    generator = torch.Generator().manual_seed(0)
    found, told = [], []
    for _ in range(8):
        noisy = p.landmarks + torch.randn(p.landmarks.shape, generator=generator).double()
        fit = fit_images(model, rig, noisy, SIZE, camera=p.focal, settings=replace(settings, transfers=0))
        found.append(fit.coefficients)
        told.append(fit.covariance.diagonal()[: model.shape.count].sqrt())
    spread, told_mean = torch.stack(found).std(0), torch.stack(told).mean(0)
    # The posterior also counts what the prior leaves open: it may tell more than noise alone spreads, never much less.
    assert float((spread / told_mean).mean()) < 1.1
    assert float((spread / told_mean).mean()) > 0.4


def test_missing_landmarks_are_left_out(rig: BlendshapeRig, model: HeadModel) -> None:
    p = person(rig, model, 6)
    gaps = p.landmarks.clone()
    gaps[0, :20] = torch.nan
    gaps[2, ::3] = torch.nan
    skin = model.annotations.regions["face"]
    fit = fit_images(model, rig, gaps, SIZE, camera=p.focal, settings=replace(FIXED, transfers=0))
    assert torch.equal(torch.isnan(fit.residuals), torch.isnan(gaps))
    assert torch.isfinite(fit.errors).all()
    assert aligned_error(fit.mesh.vertices[skin], p.rest[skin]) < 0.4 * aligned_error(
        model.shape.mean[skin], p.rest[skin]
    )


def test_focal_lengths_are_estimated(rig: BlendshapeRig, model: HeadModel) -> None:
    p = person(rig, model, 7)
    settings = replace(FIXED, focal_deviation=0.15)
    fit = fit_images(model, rig, p.landmarks, SIZE, camera=1.2 * p.focal, settings=replace(settings, transfers=0))
    found = torch.stack([camera.intrinsics[0, 0] for camera in fit.cameras])
    assert float((found / p.focal - 1).abs().max()) < 0.1
    known = fit_images(model, rig, p.landmarks, SIZE, camera=6000.0, settings=replace(FIXED, transfers=0))
    assert all(float(camera.intrinsics[0, 0]) == 6000.0 for camera in known.cameras)


def test_transferred_shapes_explain_a_persons_own(rig: BlendshapeRig, model: HeadModel) -> None:
    few = rig.select(list(EXPRESSION))
    weights = torch.tensor([list(EXPRESSION.values())])
    skin = model.annotations.regions["face"]
    errors = []
    for seed in (11, 12):
        rest = model.shape(torch.randn(1, model.shape.count, generator=torch.Generator().manual_seed(seed)))[0]
        face = transfer_deformation(few, few.neutral.with_vertices(rest))(weights)[0]
        cameras = portraits(face, rig)
        seen = torch.stack([camera.project(face[rig.neutral.landmarks].double()) for camera in cameras])
        focal = float(cameras[0].intrinsics[0, 0])
        for turns in (0, 1):
            fit = fit_images(model, few, seen, SIZE, camera=focal, settings=replace(FIXED, transfers=turns))
            errors.append(aligned_error(fit.posed[0].vertices[skin], face[skin]))
    without, with_transfer = errors[0] + errors[2], errors[1] + errors[3]
    assert with_transfer < 0.8 * without


def snapshots(rig: BlendshapeRig, face: Tensor, poses: list[tuple[float, dict[str, float]]], seed: int) -> Tensor:
    """Landmarks of pictures of a head at rest (V,3) with an angle and an expression each, half a pixel of noise."""
    views = []
    for yaw, weights in poses:
        row = torch.zeros(1, len(rig.names))
        row[0, rig.index(list(weights))] = torch.tensor(list(weights.values()))
        posed = face + rig(row)[0] - rig.vertices
        camera = look_at(posed[rig.neutral.landmarks].mean(0), yaw, 3.0, span=300.0, width=SIZE[0], height=SIZE[1])
        views.append(camera.project(posed[rig.neutral.landmarks].double()))
    seen = torch.stack(views)
    return seen + 0.5 * torch.randn(seen.shape, generator=torch.Generator().manual_seed(seed)).double()


LAUGH = {"jawOpen": 0.4, "mouthSmileLeft": 0.8, "mouthSmileRight": 0.8}
POUT = {"mouthPucker": 0.7, "browDownLeft": 0.6, "browDownRight": 0.6}
POINTS = replace(FIXED, one_expression=False, transfers=0)


def test_pictures_of_different_expressions_give_one_head(rig: BlendshapeRig, model: HeadModel) -> None:
    skin = model.annotations.regions["face"]
    apart, together = [], []
    for seed in range(2):
        rest = model.shape(torch.randn(1, 15, generator=torch.Generator().manual_seed(seed)))[0]
        marks = snapshots(rig, rest, [(0.0, LAUGH), (35.0, POUT)], seed)
        fit = fit_images(model, rig, marks, SIZE, settings=POINTS)
        one = fit_images(model, rig, marks, SIZE, settings=replace(POINTS, one_expression=True))
        for row, shapes, others in ((0, LAUGH, POUT), (1, POUT, LAUGH)):
            shown, hidden = (float(fit.weights[row, rig.index(list(some))].mean()) for some in (shapes, others))
            assert shown > hidden + 0.3
        assert torch.equal(fit.posed[0].vertices - fit.mesh.vertices != 0, fit.posed[0].vertices != fit.mesh.vertices)
        together.append(aligned_error(fit.mesh.vertices[skin], rest[skin]))
        apart.append(aligned_error(one.mesh.vertices[skin], rest[skin]))
    assert sum(together) < 0.8 * sum(apart)


@pytest.mark.bench
def test_more_pictures_give_a_better_head(rig: BlendshapeRig, model: HeadModel) -> None:
    skin, errors = model.annotations.regions["face"], torch.zeros(4)
    poses = [(0.0, LAUGH), (35.0, POUT), (-40.0, {}), (10.0, EXPRESSION)]
    for seed in range(2):
        rest = model.shape(torch.randn(1, 15, generator=torch.Generator().manual_seed(20 + seed)))[0]
        marks = snapshots(rig, rest, poses, seed)
        for count in range(4):
            fit = fit_images(model, rig, marks[: count + 1], SIZE, settings=POINTS)
            errors[count] += aligned_error(fit.mesh.vertices[skin], rest[skin]) / 2
    assert bool((errors[1:] < 1.05 * errors[:-1]).all())
    assert float(errors[3]) < 0.7 * float(errors[0])


def test_a_difference_that_the_model_does_not_know_is_found(rig: BlendshapeRig, model: HeadModel) -> None:
    """A mouth 5 mm wider than any in the model; heads that the model knows are its own but for 0.1 mm."""
    skin, middle = model.annotations.regions["face"], rig.vertices[rig.neutral.landmarks[48:68]].mean(0)
    near = torch.exp(-(rig.vertices - middle).square().sum(1) / (2 * 20.0**2))
    wider = torch.stack([0.2 * (rig.vertices - middle)[:, 0] * near, 0 * near, 0 * near], dim=1)
    poses, held = [(0.0, {}), (35.0, {}), (-35.0, {})], replace(POINTS, unknown_deviation=0.0)
    for change, known in ((wider, False), (0 * wider, True)):
        ours, theirs = 0.0, 0.0
        for seed in range(2):
            rest = model.shape(torch.randn(1, 15, generator=torch.Generator().manual_seed(30 + seed)))[0] + change
            marks = snapshots(rig, rest, poses, seed)
            free, model_alone = (fit_images(model, rig, marks, SIZE, settings=some) for some in (POINTS, held))
            assert free.coefficients.shape == model_alone.coefficients.shape == (15,)
            ours += aligned_error(free.mesh.vertices[skin], rest[skin])
            theirs += aligned_error(model_alone.mesh.vertices[skin], rest[skin])
        assert (ours - theirs) / 2 < 0.1 if known else ours < 0.7 * theirs


def test_landmarks_as_annotators_put_them_are_no_other_face(rig: BlendshapeRig, model: HeadModel) -> None:
    """Of a picture in which eyes end before their corners, and brows lie lower, neither does in the head."""
    notes, at = rig.neutral.annotations, annotated_vertices(model.shape.mean, rig.neutral.landmarks)
    neutral = replace(rig.neutral, annotations=replace(notes, landmarks=at))
    as_seen = BlendshapeRig(neutral, rig.deltas, rig.names)
    errors = {True: 0.0, False: 0.0}
    for seed in range(2):
        rest = model.shape(torch.randn(1, 15, generator=torch.Generator().manual_seed(50 + seed)))[0]
        marks = as_annotated(snapshots(as_seen, rest, [(0.0, {})], seed))
        for annotated in errors:
            fit = fit_images(model, rig, marks, SIZE, settings=replace(POINTS, annotated=annotated))
            errors[annotated] += float(fit.errors[0])
            if annotated:
                corners = rig.neutral.landmarks[[36, 45]]
                found, true = ((v[corners[0]] - v[corners[1]]).norm() for v in (fit.mesh.vertices, rest))
                assert abs(float(found / true) - 1) < 0.05
                assert float(fit.weights[0, rig.index(["browDownLeft", "browDownRight"])].max()) < 0.1
    assert errors[True] < errors[False]


def test_landmarks_count_by_their_deviations(rig: BlendshapeRig, model: HeadModel) -> None:
    """A mouth that is found 30 pixels aside, and said to be uncertain, bends the head less."""
    skin, errors = model.annotations.regions["face"], torch.zeros(2)
    deviations = torch.ones(1, 68)
    deviations[:, 48:] = 4.0
    for seed in range(2):
        rest = model.shape(torch.randn(1, 15, generator=torch.Generator().manual_seed(60 + seed)))[0]
        marks = snapshots(rig, rest, [(20.0, {})], seed)
        marks[:, 48:, 0] += 30.0
        for row, some in enumerate((None, deviations)):
            fit = fit_images(model, rig, marks, SIZE, settings=replace(POINTS, deviations=some))
            errors[row] += aligned_error(fit.mesh.vertices[skin], rest[skin])
    assert float(errors[1]) < 0.95 * float(errors[0])
    with pytest.raises(ShapeError, match="found 2 views, expected 1"):
        fit_images(model, rig, marks, SIZE, settings=FitSettings(deviations=torch.ones(2, 68)))
    with pytest.raises(ShapeError, match=r"deviations: found \(1, 5\)"):
        FitSettings(deviations=torch.ones(1, 5))


def test_a_laugh_goes_to_a_smile_by_the_prior(rig: BlendshapeRig, model: HeadModel) -> None:
    """Of a face that is nobody's in the model and laughs at the camera, what a laugh has beside stays small."""
    prior = zoo.get_model("shape_prior").renamed(rig.names)
    laugh = LAUGH | dict.fromkeys(("mouthUpperUpLeft", "mouthUpperUpRight", "cheekSquintLeft", "cheekSquintRight"), 0.4)
    names, others = list(laugh), ["mouthFunnel", "noseSneerLeft", "noseSneerRight", "mouthPucker"]
    off, strays = {}, {}
    for name, settings in (("prior", replace(POINTS, expression_prior=prior)), ("none", POINTS)):
        off[name], strays[name] = 0.0, 0.0
        for seed in range(2):
            rest = model.shape(torch.randn(1, 15, generator=torch.Generator().manual_seed(40 + seed)))[0]
            fit = fit_images(model, rig, snapshots(rig, rest, [(0.0, laugh)], seed), SIZE, settings=settings)
            off[name] += float((fit.weights[0, rig.index(names)] - torch.tensor(list(laugh.values()))).abs().mean()) / 2
            strays[name] += float(fit.weights[0, rig.index(others)].max()) / 2
    assert off["prior"] < off["none"]
    assert strays["prior"] < 0.2


def test_points_of_the_surface_tell_a_head_better(rig: BlendshapeRig, model: HeadModel) -> None:
    """With landmarks 3 pixels off, 150 points whose errors go together with their neighbours' still help."""
    generator = torch.Generator().manual_seed(5)
    skin = rig.neutral.annotations.regions["face"] & (rig.vertices[:, 2] > 40)
    chosen = skin.nonzero()[:, 0][torch.randperm(int(skin.sum()), generator=generator)[:150]]
    sites = Attachment.from_vertices(rig.neutral, chosen)
    places = torch.cat([rig.vertices[rig.neutral.landmarks], rig.vertices[chosen]]).double()
    alike = 0.5 * (-torch.cdist(places, places) / 25).exp()
    alike.diagonal().fill_(1.0)
    root = torch.linalg.cholesky(alike)
    errors = {"landmarks": 0.0, "surface": 0.0}
    for seed in range(3):
        who = person(rig, model, seed, noise=0.0)
        seen = torch.stack([camera.project(who.face[chosen].double()) for camera in who.cameras])
        noise = 3 * root @ torch.randn(3, len(places), 2, generator=generator).double()
        marks, points = who.landmarks + noise[:, :68], seen + noise[:, 68:]
        deviations = torch.full((3, 68), 2.5), torch.full((3, 150), 4.0)
        settings = replace(FIXED, transfers=0, deviations=deviations[0])
        both = replace(settings, surface=SurfacePoints(points, deviations[1], sites))
        for name, one in (("landmarks", settings), ("surface", both)):
            fit = fit_images(model, rig, marks, SIZE, camera=who.focal, settings=one)
            assert fit.residuals.shape == (3, 68, 2)
            errors[name] += aligned_error(fit.mesh.vertices[skin], who.rest[skin])
    assert errors["surface"] < 0.8 * errors["landmarks"]


def test_errors_that_go_together_are_whitened(rig: BlendshapeRig, model: HeadModel) -> None:
    curves = contour_curves(rig.vertices, rig.neutral.faces, rig.neutral.landmarks)
    sites = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks[17:30])
    placed = LandmarkSites(rig.neutral.landmarks, curves, False, rig.neutral.faces, sites)
    points = LinearPoints.of(rig.vertices, model.shape.modes, placed)
    assert points.count == 81
    found = torch.rand(1, 81, 2, dtype=torch.float64)
    found[0, 3] = torch.nan
    surface = SurfacePoints(found[:, 68:], torch.ones(1, 13), sites)
    problem = Problem(points, 15, found, torch.ones(1), FitSettings(surface=surface, deviations=torch.ones(1, 68)))
    inverse = torch.linalg.inv(problem.mixing[0])
    alike = inverse @ inverse.T  # the 17th landmark twice, and once a landmark that is missing
    assert torch.isclose(alike[17, 68], torch.tensor(0.5).double())
    assert torch.equal(alike[3, :3].round(decimals=9), torch.zeros(3).double())
    assert torch.allclose(alike.diagonal(), torch.ones(81).double())


def test_their_variance_is_that_of_a_process_made_symmetric() -> None:
    head = neutral_head(texture=False)
    marks = head.landmarks
    x = head.vertices[marks].double()
    modes = smooth_differences(head.vertices, marks, 2.0)[:, marks].double()
    covariance = torch.einsum("mla,mka->alk", modes, modes)
    mirrored = x * x.new_tensor([-1.0, 1.0, 1.0])
    near, across = (torch.exp(-torch.cdist(x, y).square() / (2 * 20.0**2)) for y in (x, mirrored))
    for axis, sign in enumerate((-1.0, 1.0, 1.0)):
        expected = 2.0 * (near + sign * 0.5 * (across + across.T))  # 2², halved
        assert float((covariance[axis] - expected).abs().max()) < 0.15


def test_both_sides_move_alike() -> None:
    head = neutral_head(texture=False)
    twin = head.annotations.mirror
    modes = smooth_differences(head.vertices, head.landmarks, 1.0)
    flipped = modes[:, twin] * torch.tensor([-1.0, 1.0, 1.0])
    assert float((modes - flipped).abs().max()) < 0.02


def test_none_are_expected() -> None:
    head = neutral_head(texture=False)
    assert smooth_differences(head.vertices, head.landmarks, 0.0).shape == (0, len(head.vertices), 3)


def test_eyeballs_are_not_bent() -> None:
    head = neutral_head()
    modes = with_whole_eyeballs(smooth_differences(head.vertices, head.landmarks, 1.0), head)
    ball = head.annotations.regions["eyeball_left"]
    moved = modes[:, ball]
    assert float(moved.norm(dim=-1).amax()) > 0.1
    assert float((moved - moved[:, :1]).abs().max()) == 0
