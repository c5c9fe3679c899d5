"""A head from landmarks in photographs: identity, expression and cameras at once."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.errors import AlignmentError, ShapeError
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.cameras.pnp import Pose, solve_pnp
from torchface.geometry.cameras.sliding_contour import LevelCurves, level_curves
from torchface.geometry.similarity import similarity_transform
from torchface.mesh import Mesh
from torchface.modeling.morphable.head_model import HeadModel
from torchface.modeling.photographs.face_piece import FacePiece
from torchface.modeling.photographs.feature_alignment import FeatureAlignment
from torchface.modeling.photographs.fit_problem import Problem, State
from torchface.modeling.photographs.fit_settings import FitSettings
from torchface.modeling.photographs.image_input import (
    annotated_vertices,
    check_images,
    checked_landmark_vertices,
    checked_sizes,
    lens,
)
from torchface.modeling.photographs.image_solve import covariance, solve, solve_either
from torchface.modeling.photographs.image_texture import photographed_skin
from torchface.modeling.photographs.landmark_view import JAW, LANDMARKS, LandmarkSites, LinearPoints, Views
from torchface.modeling.photographs.multiple_views import HeldMarks, ShownHead, SkinAgreement, agreed_skin
from torchface.modeling.photographs.texture_fit import ColorFit
from torchface.modeling.rigging.deformation_transfer import transfer_with_report
from torchface.part_materials import EYEBALL, part_material
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig
from torchface.shape_names import mirror

_MAX_ANGLE = 100.0  # degrees from the camera; a face rotated further shows none of its inner landmarks
_MAX_MISFIT = 0.25  # of the face's size; the mean face fits landmarks of strong expressions better than this
_HELD = 1.0  # deviations of a landmark beside hundreds of matches
_SHOWS = 0.5  # millimetres at a landmark by which a shape has to show for its personal form to matter


@dataclass(frozen=True, eq=False)
class ImageFit:
    """A person's head, found in I photographs with 68 landmarks each.

    Args:
        mesh: the head at rest, with the rig's topology and skin; it stands as the rig's head, in the model's size.
        posed: the same with the expression of each photograph.
        coefficients: of the model's modes of identity, (K,), standard deviations; of what the model does not know the
            head has more.
        weights: of the rig's shapes in each photograph, (I,N).
        cameras: one a photograph.
        residuals: where the fit's landmarks are seen minus where they were found, (I,68,2), pixels, NaN for missing.
        landmarks: where the fit's landmarks are seen, (I,68,2), pixels.
        noise: estimated deviation of an inner landmark, pixels of a photograph of mean size.
        covariance: of coefficients and weights of each expression, (K+EN,K+EN).
        color: the colour model's fit to the photographs; None without one, or without photographs.
        hair: its colour, (3,); None where photographs show a bald head.
        iris: the irises' colour, (3,); None where no photograph shows it.
        fringe: whether hair hangs over the forehead.
        agreement: what the skin that several photographs show moved the head by; None with one photograph, without
            images, where they do not agree, or the head agrees with them already.
    """

    mesh: Mesh
    posed: tuple[Mesh, ...]
    coefficients: Tensor
    weights: Tensor
    cameras: tuple[Camera, ...]
    residuals: Tensor
    landmarks: Tensor
    noise: float
    covariance: Tensor
    color: ColorFit | None = None
    hair: Tensor | None = None
    iris: Tensor | None = None
    fringe: bool = False
    agreement: SkinAgreement | None = None

    @property
    def errors(self) -> Tensor:
        """Root mean square distance of the landmarks in each photograph, (I,), pixels."""
        return self.residuals.square().sum(-1).nanmean(-1).sqrt()


def fit_images(
    model: HeadModel,
    rig: BlendshapeRig,
    landmarks: Tensor,
    image_size: tuple[int, int] | Sequence[tuple[int, int]],
    images: Sequence[Tensor] | None = None,
    camera: float | Tensor | None = None,
    settings: FitSettings | None = None,
    progress: Progress | None = None,
) -> ImageFit:
    r"""The head whose landmarks are seen where photographs show them.

    .. math:: \min_{a,u,w,P} \sum_{i,l} c_l
              \lVert P_i(\bar S + u + \sum_k a_k s_k + \sum_n w_{in} B_n)_{v_l} - q_{il} \rVert^2 / \sigma^2
              + \lVert a \rVert^2 + \lVert u \rVert^2_{GP} + \sum_i \rho(w_i), \quad |a| \le 3, \; 0 \le w \le 1

    u are smooth differences of heads that the model does not know. PnP gives initial poses; then all moves at once,
    each step a quadratic program in a box. At the end the shapes that show are transferred to the head found, which
    then stands as the rig's does.

    Args:
        model: heads at rest.
        rig: template with the model's topology. Its annotated landmarks are seen, or the model's where it has none.
        landmarks: in iBUG's order, (I,68,2), pixels, x right, y down; NaN for missing.
        image_size: (width, height) of all photographs, or one for each.
        images: the photographs, (3,H,W) in [0,1] each, for the head's skin; see ``photographed_skin``.
        camera: focal length in pixels (the thesis takes 6000), or K (3,3) or (I,3,3); taken as exact unless
            ``settings.focal_deviation`` gives its deviation. Estimated if absent.
        settings: the noise of landmarks, transfers of shapes, the skin; see ``FitSettings``.
        progress: called with each step and how far it is.

    Returns:
        The head, what it took to find it, and how sure it is; see ``ImageFit``. Solved in float64 on the CPU.

    Raises:
        ShapeError: the landmarks are not (I,68,2), or sizes do not fit.
        ArgumentTypeError: images that are no floating-point numbers.
        TopologyError: model and rig have other triangles.
        ValueRangeError: too few landmarks in a view, or landmarks outside its image.
        AlignmentError: a face seen from behind, or landmarks that are not a face's in iBUG's order.

    Source: thesis 3.2.5, algorithm 2, equations 12 to 17.

    Example:
        >>> from torchface import zoo
        >>> from torchface.geometry.cameras.pinhole import look_at
        >>> from torchface.synthetic import performer
        >>> model, rig = zoo.get_model("head"), performer(texture=False).select(["jawOpen"])
        >>> points = model.template().vertices[rig.neutral.landmarks].double()
        >>> camera = look_at(points.mean(0), yaw=20.0, width=600, height=800)
        >>> fit = fit_images(model, rig, camera.project(points)[None], (600, 800), settings=FitSettings(transfers=0))
        >>> fit.errors.item() < 5  # pixels
        True
    """
    progress = progress or silent
    rig = rig.linear("fit_images")
    vertices = checked_landmark_vertices(model, rig)
    sizes = checked_sizes(landmarks, image_size)
    if images is not None:
        check_images(images, sizes)
    if settings is not None and settings.deviations is not None and len(settings.deviations) != len(landmarks):
        raise ShapeError(f"deviations: found {len(settings.deviations)} views, expected {len(landmarks)}")
    intrinsics, settings = lens(camera, sizes, settings or FitSettings())
    pixels = landmarks.detach().cpu().double()
    mean = model.shape.mean.cpu()
    vertices = annotated_vertices(mean, vertices) if settings.annotated else vertices
    unknown = with_whole_eyeballs(smooth_differences(mean, vertices, settings.unknown_deviation), rig.neutral)
    modes = torch.cat([model.shape.modes.cpu(), unknown])
    deltas = _in_place(rig, mean)
    faces, surface = model.faces.cpu(), settings.surface
    curves = contour_curves(mean, faces, vertices)
    sites = LandmarkSites(vertices, curves, settings.annotated, faces, None if surface is None else surface.sites)
    points = LinearPoints.of(mean, torch.cat([modes, deltas]), sites)
    progress("placing the cameras")
    pose = _checked_pose(points.mean[:LANDMARKS], pixels, intrinsics)
    found = pixels if surface is None else torch.cat([pixels, surface.points.double()], dim=1)
    problem = Problem(points, len(modes), found, intrinsics[:, 0, 0], settings, _twins(rig.names), len(unknown))
    initial = State(
        torch.zeros(problem.unknowns, dtype=torch.float64),
        Views(intrinsics, pose.rotation, pose.translation),
        torch.arange(points.count).expand(len(pixels), -1),
        float(pose.errors.mean()) if settings.noise is None else settings.noise,
    )
    progress("fitting identity and expression")
    problem, state = solve_either(problem, initial)
    for number in range(settings.transfers):
        progress("copying the template's expressions to the head", number, settings.transfers)
        weights = problem.weights(state.coefficients).float().amax(0)
        rest = mean + torch.tensordot(state.coefficients[: len(modes)].float(), modes, dims=1)
        deltas = _personal(rig, deltas, weights, vertices, rest)
        points = LinearPoints.of(mean, torch.cat([modes, deltas]), sites)
        problem = replace(problem, points=points)
        state = solve(problem, state)
    head = _Head(mean, modes, deltas)
    fit = _result(problem, state, rig.neutral, head, sizes)
    if images is not None and len(images) > 1 and settings.match_skin:
        progress("matching the skin between the photographs")
        agreement = _agreement(fit, images, modes[: len(modes) - len(unknown)], vertices[JAW:], settings)
        if agreement is not None:
            head = replace(head, mean=mean + agreement.moved.float())
            points = LinearPoints.of(head.mean, torch.cat([modes, deltas]), sites)
            problem, state = replace(problem, points=points), replace(state, views=Views.of(agreement.cameras))
            fit = replace(_result(problem, state, rig.neutral, head, sizes), agreement=agreement)
    fit = _standing_as(rig.neutral, vertices, fit)
    if images is None:
        return fit
    progress("projecting the photographs onto the head")
    return with_skin(fit, model, images, settings)


def with_skin(fit: ImageFit, model: HeadModel, images: Sequence[Tensor], settings: FitSettings) -> ImageFit:
    """A fit with the skin that its photographs (3,H,W) show, completed with the model's colours where it has some."""
    bent = [FeatureAlignment.of(*one) for one in zip(fit.landmarks, fit.residuals, strict=True)]
    images = [way.image(image[:3].cpu()) for way, image in zip(bent, images, strict=True)]
    if settings.parts is not None:
        settings = replace(settings, parts=[way.parts(one) for way, one in zip(bent, settings.parts, strict=True)])
    if settings.irises is not None:
        irises = [way.points(one) for way, one in zip(bent, settings.irises, strict=True)]
        settings = replace(settings, irises=torch.stack(irises))
    skin = photographed_skin(fit.posed, model.color, images, fit.cameras, settings, fit.mesh)
    return replace(
        fit,
        mesh=skin.on(fit.mesh),
        posed=tuple(map(skin.on, fit.posed)),
        color=skin.fit,
        hair=skin.hair,
        iris=skin.iris,
        fringe=skin.fringe,
    )


@dataclass(frozen=True, eq=False)
class _Head:
    """A head by coefficients of identity and weights."""

    mean: Tensor  # (V,3)
    modes: Tensor  # (K,V,3)
    deltas: Tensor  # (N,V,3)


def _agreement(
    fit: ImageFit, images: Sequence[Tensor], modes: Tensor, inner: Tensor, settings: FitSettings
) -> SkinAgreement | None:
    """What the skin in several photographs says of a fit; inner landmarks keep their places."""
    pieces = [FacePiece.around(image.cpu(), marks) for image, marks in zip(images, fit.landmarks, strict=True)]
    places = [one.project(mesh.vertices[inner].double()) for mesh, one in zip(fit.posed, fit.cameras, strict=True)]
    marks = HeldMarks(inner, torch.stack(places) - fit.residuals[:, JAW:], _HELD * fit.noise)
    head = ShownHead(fit.posed, fit.cameras, modes, settings.focal_deviation, settings.shared_focal)
    return agreed_skin(head, pieces, marks, settings.parts)


def _result(problem: Problem, state: State, template: Mesh, head: _Head, sizes: Tensor) -> ImageFit:
    mean, modes, deltas = head.mean, head.modes, head.deltas
    whole, known = state.coefficients[: len(modes)].float(), len(modes) - problem.smooth
    weights = problem.weights(state.coefficients).float().expand(len(problem.found), -1)
    rest = mean + torch.tensordot(whole, modes, dims=1)
    shown = rest + torch.tensordot(weights, deltas, dims=1)
    kept = torch.ones(problem.unknowns, dtype=torch.bool)
    kept[known : len(modes)] = False
    views = state.views
    cameras = tuple(
        Camera(K, R, t, int(width), int(height))
        for K, R, t, (width, height) in zip(
            views.intrinsics, views.rotation, views.translation, sizes.tolist(), strict=True
        )
    )
    rows = state.rows[:, :LANDMARKS]
    seen = views.pixels(problem.points.picked(rows).at(state.coefficients[problem.rows]))
    mesh = template.to("cpu")
    return ImageFit(
        mesh.with_vertices(rest),
        tuple(mesh.with_vertices(one) for one in shown),
        whole[:known],
        weights,
        cameras,
        seen - problem.found[:, :LANDMARKS],
        seen,
        state.noise,
        covariance(problem, state)[kept][:, kept],
    )


def _standing_as(template: Mesh, landmarks: Tensor, fit: ImageFit) -> ImageFit:
    """A fit whose head stands as a template does, and its cameras as before to it.

    A face that is turned in its own coordinates, and cameras that are turned back, show the same. The mean head of a
    model may be turned beside the template, and heads found beside it; the gaze and pose of who is tracked were, too.
    """
    own, there = (one.vertices[landmarks][None].detach().cpu().double() for one in (fit.mesh, template))
    motion = similarity_transform(own, there, scale=False)
    turn, shift = motion.rotation[0], motion.translation[0]
    mesh, *posed = (
        one.with_vertices(motion.apply(one.vertices.double())[0].to(one.vertices)) for one in (fit.mesh, *fit.posed)
    )
    cameras = []
    for camera in fit.cameras:
        rotation = camera.rotation.double() @ turn.T
        cameras.append(replace(camera, rotation=rotation, translation=camera.translation.double() - rotation @ shift))
    agreement = fit.agreement and replace(fit.agreement, moved=fit.agreement.moved @ turn.T, cameras=tuple(cameras))
    return replace(fit, mesh=mesh, posed=tuple(posed), cameras=tuple(cameras), agreement=agreement)


def _in_place(rig: BlendshapeRig, mean: Tensor) -> Tensor:
    """The rig's deltas (N,V,3) where the model's heads are, rotated and scaled as they are."""
    rest, deltas = rig.vertices.detach().cpu(), rig.deltas.detach().cpu()
    if torch.allclose(rest, mean, atol=1e-3):
        return deltas.float()
    return similarity_transform(rest[None], mean[None]).apply_vectors(deltas).float()


def _twins(names: Sequence[str]) -> Tensor:
    """Pairs (K,2) of shapes that mirror each other; eyes look to one side together, so their shapes are none."""
    twin = mirror(names)
    first = [i for i, name in enumerate(names) if i < int(twin[i]) and "look" not in name.lower()]
    return torch.stack([torch.tensor(first, dtype=torch.int64), twin[first]], dim=1)


def contour_curves(mean: Tensor, faces: Tensor, landmarks: Tensor) -> LevelCurves:
    """Where the contour landmarks of a head (V,3) slide: over the skin, but not over the nose."""
    x, y = mean[:, 0].abs(), mean[:, 1]
    wing, top, bottom = float(x[landmarks[[31, 35]]].max()), float(y[landmarks[27]]), float(y[landmarks[33]])
    nose = (x < 1.2 * wing) & (y < top) & (y > bottom - 0.1 * (top - bottom))
    return level_curves(mean, faces[~nose[faces].any(1)], landmarks[:JAW])


def _checked_pose(mean: Tensor, found: Tensor, intrinsics: Tensor) -> Pose:
    """By the inner landmarks, which mean the same points whatever the pose."""
    inner = torch.ones(LANDMARKS, dtype=torch.float64)
    inner[:JAW] = 0
    pose = solve_pnp(mean, found, intrinsics, inner)
    marks = found[:, JAW:]
    size = (marks - marks.nanmean(1, keepdim=True)).square().sum(-1).nanmean(1).sqrt()
    angle = torch.rad2deg(torch.arccos((-pose.rotation[:, 2, 2]).clamp(-1, 1)))
    for i in range(len(found)):  # a view at a time, for its message
        share = float(pose.errors[i] / size[i])
        if share > _MAX_MISFIT:
            raise AlignmentError(
                f"landmarks: found view {i}'s {share:.0%} of their extent from a face's, expected less than "
                f"{_MAX_MISFIT:.0%}; are they in iBUG's order of 68, x before y?"
            )
        if float(angle[i]) > _MAX_ANGLE:
            raise AlignmentError(
                f"landmarks: found a face rotated by {float(angle[i]):.0f}° in view {i}, as if seen from behind, "
                f"expected at most {_MAX_ANGLE:.0f}°; are left and right swapped, or is y up?"
            )
    return pose


def _personal(rig: BlendshapeRig, deltas: Tensor, weights: Tensor, landmarks: Tensor, rest: Tensor) -> Tensor:
    """The deltas (N,V,3) with those shapes that show at a landmark transferred to a head at rest (V,3)."""
    shows = weights * deltas[:, landmarks].norm(dim=-1).amax(1) > _SHOWS
    names = [name for name, shown in zip(rig.names, shows.tolist(), strict=True) if shown]
    if not names:
        return deltas
    transferred = transfer_with_report(rig.select(names), rig.neutral.with_vertices(rest.to(rig.vertices)))
    deltas = deltas.clone()
    deltas[shows] = transferred.rig.deltas.cpu().float()
    return deltas


_LENGTH = 20.0  # millimetres over which a difference is alike
_MODES = 20  # an axis
_LEAST_VARIANCE = 1e-3


def smooth_differences(vertices: Tensor, landmarks: Tensor, deviation: float) -> Tensor:
    r"""The ways in which heads differ smoothly and alike on both sides, likeliest first for each axis, (M,V,3).

    .. math:: u(x) \sim GP\bigl(0,\; s^2 \exp(-\lVert x - y \rVert^2 / 2 l^2)\bigr), \quad l = 20\,\text{mm}

    made symmetric about x = 0, known at the landmarks, and elsewhere what those lead to expect.

    Args:
        vertices: of the mean head, (V,3), millimetres.
        landmarks: vertex ids, (L,).
        deviation: s, of a coordinate, millimetres; 0 gives no modes.

    Source: Lüthi, Gerig, Jud and Vetter 2018 (Gaussian process morphable models).
    """
    x = vertices.detach().cpu().double()
    if deviation == 0:
        return x.new_zeros(0, *x.shape, dtype=torch.float32)
    at = x[landmarks]
    mirrored = at * at.new_tensor([-1.0, 1.0, 1.0])
    modes = []
    for axis in range(3):
        sign = -1.0 if axis == 0 else 1.0
        values, vectors = torch.linalg.eigh(_symmetric(at, at, mirrored, sign))
        kept = values.flip(0)[:_MODES] > _LEAST_VARIANCE
        values, vectors = values.flip(0)[:_MODES][kept], vectors.flip(1)[:, :_MODES][:, kept]
        field = x.new_zeros(len(values), *x.shape)
        field[..., axis] = deviation * (_symmetric(x, at, mirrored, sign) @ vectors / values.sqrt()).T
        modes.append(field)
    return torch.cat(modes).float()


def with_whole_eyeballs(fields: Tensor, mesh: Mesh) -> Tensor:
    """Displacements (M,V,3) of a mesh that move each of its annotated eyeballs without bending it."""
    for name, mask in mesh.regions.items():
        if part_material(name) is EYEBALL and bool(mask.any()):
            ball = mask.to(fields.device)
            fields[:, ball] = fields[:, ball].mean(1, keepdim=True)
    return fields


def _symmetric(x: Tensor, at: Tensor, mirrored: Tensor, sign: float) -> Tensor:
    """The covariance (X,L) of the half of a field that is the mirror image of itself."""
    near, across = (torch.exp(-torch.cdist(x, y).square() / (2 * _LENGTH**2)) for y in (at, mirrored))
    both = 0.5 * (near + sign * across)
    return 0.5 * (both + both.T) if len(both) == len(at) else both
