"""Planted heads for the benchmark of fits to images, and the rows of its tables."""

import time
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from planted.photographed_heads import aligned_error
from torchface import Attachment
from torchface.geometry.cameras.pnp import Pose, solve_pnp
from torchface.geometry.rotations import rotation_matrix
from torchface.modeling import FitSettings, HeadModel, ImageFit, MorphableModel, fit_images
from torchface.modeling.photographs.fit_problem import Problem, State, whitening
from torchface.modeling.photographs.image_fit import contour_curves
from torchface.modeling.photographs.landmark_view import (
    JAW,
    LANDMARKS,
    LandmarkSites,
    LinearPoints,
    Views,
    chosen_points,
    linearised,
)
from torchface.optim import box_qp
from torchface.rig import BlendshapeRig

SIZE = (1280, 1024)


FOCAL, SPREAD = 1600.0, 0.12  # a uniform ±20 % has a deviation of 0.115


HEADS = range(50)


PORTRAITS = (-40.0, 0.0, 40.0)


Capture = tuple[BlendshapeRig, Attachment, list[Tensor]]


@dataclass(frozen=True, eq=False)
class Faces:
    """The real rig's face, its identity modes and the real takes as its weights."""

    rig: BlendshapeRig
    modes: Tensor
    takes: list[Tensor]

    def model(self, count: int) -> HeadModel:
        sizes = self.modes[:count].flatten(1).norm(dim=1)
        shape = MorphableModel(self.rig.vertices, self.modes[:count] / sizes[:, None, None], sizes)
        return HeadModel.on(self.rig.neutral, shape)


@dataclass(frozen=True, eq=False)
class Planted:
    """A head at rest and as it is seen, (V,3) each, its landmarks in each view, and the focal length."""

    rest: Tensor
    face: Tensor
    landmarks: Tensor
    focal: float


def alternate(problem: Problem, state: State, iterations: int = 40) -> State:
    """Poses by PnP, then identity, then expression, each with the others held, ``iterations`` times.

    Focal lengths stay as they are. The energy is that of ``solve``, so that only the way to its minimum differs.
    Source: thesis 3.2.5, algorithm 2, lines 6 to 8.
    """
    lower, upper = problem.bounds()
    precision, linear = problem.prior(state)
    weights = torch.ones(LANDMARKS, dtype=torch.float64)
    weights[: len(problem.points.rows)] /= problem.settings.inner_weight
    groups = torch.arange(len(lower)) < problem.identities
    for _ in range(iterations):
        rows = problem.rows
        at = problem.points.at(state.coefficients)
        if problem.settings.sliding:
            state = replace(state, rows=chosen_points(problem.points, state.coefficients[rows], state.views))
        views = state.views
        initial = Pose(views.rotation, views.translation, torch.zeros(len(views.rotation)))
        pose = solve_pnp(at[state.rows], problem.found, views.intrinsics, weights, initial)
        views = Views(views.intrinsics, pose.rotation, pose.translation)
        for free in (groups, ~groups):
            picked = problem.points.picked(state.rows)
            state = replace(state, views=views)
            factors = whitening(problem, state, picked)
            lines = linearised(picked, state.coefficients[rows], views, problem.targets, factors)
            A, r = lines.by_coefficients.flatten(0, 2), lines.residual.flatten()
            x, H = state.coefficients, A.T @ A
            low, high = torch.where(free, lower, x), torch.where(free, upper, x)
            found = box_qp(H + precision, (A.T @ r - H @ x + linear)[None], low, high, start=x[None])
            state = replace(state, coefficients=found[0])
    return state


def planted(faces: Faces, seed: int, slides: bool, yaws: tuple[float, ...] = PORTRAITS, jitter: float = 0.0) -> Planted:
    """A random head with a random expression.

    Args:
        slides: contour landmarks lie where the silhouette is seen; else they are vertices, hidden or not.
        jitter: of contour landmarks along the contour, pixels.
    """
    generator = torch.Generator().manual_seed(seed)
    rig = faces.rig
    rest = rig.vertices + torch.tensordot(torch.randn(20, generator=generator), faces.modes, dims=1)
    take = faces.takes[seed % len(faces.takes)]
    weights = take[int(torch.randint(len(take), (1,), generator=generator))]
    deltas = rig.deltas
    face = rest + torch.tensordot(weights, deltas, dims=1)
    focal = FOCAL * (0.8 + 0.4 * float(torch.rand(1, generator=generator)))
    centre = face[rig.neutral.landmarks].mean(0).double()
    intrinsics = torch.tensor([[focal, 0, (SIZE[0] - 1) / 2], [0, focal, (SIZE[1] - 1) / 2], [0, 0, 1]]).double()
    upright = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
    tilt = 0.1 * (torch.rand(len(yaws), 3, generator=generator).double() - 0.5)
    tilt[:, 1] += torch.tensor(yaws).double().deg2rad()
    rotation = upright @ rotation_matrix(tilt)
    # The face is three quarters of the picture's height.
    away = torch.tensor([0.0, 0.0, focal * 240 / (0.75 * SIZE[1])], dtype=torch.float64)
    views = Views(intrinsics.expand(len(yaws), 3, 3), rotation, away - rotation @ centre)
    marks = rig.neutral.landmarks
    curves = contour_curves(rig.vertices, rig.neutral.faces, marks)
    points = LinearPoints.of(face, faces.modes[:0], LandmarkSites(marks, curves))
    none = torch.zeros(len(yaws), 0, dtype=torch.float64)
    pixels = views.pixels(points.at(none[0])[chosen_points(points, none, views, slides)])
    line = pixels[:, :JAW]
    along = torch.cat([line[:, 1:2] - line[:, :1], line[:, 2:] - line[:, :-2], line[:, -1:] - line[:, -2:-1]], dim=1)
    along = torch.nn.functional.normalize(along, dim=-1)
    noise = torch.randn(pixels.shape, generator=generator).double()
    noise[:, :JAW] += jitter * along * torch.randn(len(yaws), JAW, 1, generator=generator).double()
    return Planted(rest, face, pixels + noise, focal)


def lip_gap(vertices: Tensor, rig: BlendshapeRig) -> float:
    upper, lower = rig.neutral.landmarks[61:64], rig.neutral.landmarks[[67, 66, 65]]
    return float((vertices[upper] - vertices[lower]).norm(dim=-1).mean())


@dataclass
class Row:
    """What one way of fitting reached over many heads."""

    error: float = 0.0
    mean: float = 0.0
    posed: float = 0.0
    gaps: tuple[float, ...] = ()
    seconds: float = 0.0

    def add(self, fit: ImageFit, truth: Planted, rig: BlendshapeRig, seconds: float) -> None:
        self.error += aligned_error(fit.mesh.vertices, truth.rest)
        self.mean += aligned_error(rig.vertices, truth.rest)
        self.posed += aligned_error(fit.posed[0].vertices, truth.face)
        self.gaps += (lip_gap(fit.posed[0].vertices, rig) - lip_gap(truth.face, rig),)
        self.seconds += seconds

    @property
    def ratio(self) -> float:
        return self.error / self.mean

    def line(self, name: str) -> str:
        n, gaps = len(self.gaps), torch.tensor(self.gaps).abs()
        return (
            f"{name:50s}{self.ratio:8.3f}{self.error / n:9.2f}{self.posed / n:9.2f}{float(gaps.mean()):9.2f}"
            f"{float(gaps.quantile(0.95)):9.2f}{self.seconds / n:9.3f}"
        )


HEADING = f"{'':50s}{'of mean':>8s}{'rest mm':>9s}{'posed mm':>9s}{'lips mm':>9s}{'95 %':>9s}{'CPU s':>9s}"


def table(faces: Faces, truths: list[Planted], model: HeadModel, transfers: int = 0, **changes: float) -> Row:
    settings = replace(FitSettings(focal_deviation=SPREAD, one_expression=True), **changes)
    row = Row()
    for truth in truths:
        start = time.process_time()
        fit = fit_images(
            model, faces.rig, truth.landmarks, SIZE, camera=FOCAL, settings=replace(settings, transfers=transfers)
        )
        row.add(fit, truth, faces.rig, time.process_time() - start)
    return row
