"""Problem of a fit to photographs: what is looked for, the errors and the prior that the solve weighs."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchface.modeling.photographs.fit_settings import FitSettings, SurfacePoints
from torchface.modeling.photographs.landmark_view import BROWS, JAW, LIPS, LinearPoints, PickedPoints, Views, Whitening

_MIN_NOISE = 1e-5  # of the focal length: finer than any landmark is found
_LEAST, _MOST, _FAR = 0.5, 4.0, 100.0  # deviations beside the median; of points of the surface
_FOUND_NOISE = 0.02  # of the distance of the eyes' outer corners
# Errors of found points, by 100 rendered pictures: of neighbours they go together as 0.5 exp(-d / 25 mm), and they are
# so much larger than stated at landmarks, smaller at points of the surface.
_TOGETHER, _ALIKE_OVER = 0.5, 25.0
_STATED_68, _STATED_POINTS = 1.2, 0.75
# By twelve films: how much of these errors is alike in all pictures of one person, whom pictures then show once and not
# each anew; and how much further landmarks of brows lie from a head's, for hair grows where it will. Lips whose edge is
# missed are seen at once: points of the skin around them move it by 0.9 % of the mouth's width if it counts no more.
ALIKE_IN_PICTURES, _BROWS_GROW, _LIPS_HOLD = 0.3, 3.0, 0.5


@dataclass(frozen=True, eq=False)
class Problem:
    """What is looked for and where it was seen."""

    points: LinearPoints  # landmarks and contour curves as functions of K coefficients of identity and N weights
    identities: int  # K; the last `smooth` of them are differences that the head model does not know
    found: Tensor  # landmarks and points of the surface, (I,68+P,2), NaN for missing
    focal: Tensor  # the expected focal lengths, (I,), pixels
    settings: FitSettings
    twins: Tensor | None = None  # rows of shapes that mirror each other, (P,2); none if absent
    smooth: int = 0  # see `smooth_differences`

    @property
    def seen(self) -> Tensor:
        """Which landmarks and points are there, (I,68+P) bool."""
        return torch.isfinite(self.found).all(-1)

    @property
    def targets(self) -> Tensor:
        """The landmarks with zeros for missing ones."""
        return torch.where(self.seen[..., None], self.found, 0.0)

    @property
    def least_noise(self) -> float:
        """Of an inner landmark, pixels: finders err alike in neighbours, which their residuals do not show."""
        eyes = float((self.found[:, 36] - self.found[:, 45]).norm(dim=-1).nan_to_num(0.0).mean())
        least = max(_MIN_NOISE * float(self.focal.mean()), self.settings.least_noise * eyes)
        if not self.settings.annotated:
            return least
        if self.settings.surface is not None and self.settings.deviations is not None:
            return max(least, _STATED_68 * float(_typical(self.settings.deviations).mean()))
        return max(least, _FOUND_NOISE * eyes)

    @cached_property
    def mixing(self) -> Tensor | None:
        """See ``Whitening``; of the points that are there."""
        if self.settings.surface is None:
            return None
        places = self.points.mean[: self.points.count]
        alike = _TOGETHER * (-torch.cdist(places, places) / _ALIKE_OVER).exp()
        alike.diagonal().fill_(1.0)
        both = self.seen[:, :, None] & self.seen[:, None]
        alike = torch.where(both, alike, torch.eye(len(places), dtype=alike.dtype))
        one = torch.eye(len(places), dtype=alike.dtype).expand_as(alike)
        return torch.linalg.solve_triangular(torch.linalg.cholesky(alike), one, upper=False)

    @property
    def identity_precision(self) -> float:
        """Of the prior on a coefficient of identity, which has a deviation of 1, beside errors that are taken to be
        independent in each picture."""
        return 1.0 if self.settings.surface is None else 1.0 + ALIKE_IN_PICTURES * (len(self.found) - 1)

    @property
    def expressions(self) -> int:
        """How many there are, E: one a view, or one for all."""
        return 1 if self.settings.one_expression else len(self.found)

    @property
    def unknowns(self) -> int:
        """D, of identity and all expressions: K + E N."""
        k = self.identities
        return k + self.expressions * (len(self.points.basis) - k)

    @property
    def rows(self) -> Tensor:
        """Which of the D coefficients each view's face follows, (I,K+N)."""
        k, count = self.identities, len(self.points.basis) - self.identities
        first = k + count * torch.arange(self.expressions)
        own = (first[:, None] + torch.arange(count)).expand(len(self.found), count)
        return torch.cat([torch.arange(k).expand(len(own), k), own], dim=1)

    def weights(self, coefficients: Tensor) -> Tensor:
        """The expressions (E,N) among coefficients (D,)."""
        return coefficients[self.identities :].unflatten(0, (self.expressions, -1))

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper, (D,)."""
        lower, upper = (make(self.unknowns, dtype=torch.float64) for make in (torch.zeros, torch.ones))
        k = self.identities
        lower[:k], upper[:k] = -self.settings.identity_bound, self.settings.identity_bound
        return lower, upper

    def prior(self, state: "State") -> tuple[Tensor, Tensor]:
        """Of the energy ½ xᵀ P x + βᵀ x: P (D,D) and β (D,); it touches that of the expressions at the state."""
        weights, k = self.weights(state.coefficients), self.identities
        count, settings = weights.shape[1], self.settings
        precision, linear = (
            torch.zeros(*shape, dtype=torch.float64) for shape in ((self.unknowns,) * 2, (self.unknowns,))
        )
        precision.diagonal()[:k] = self.identity_precision
        precision.diagonal()[k - self.smooth : k] /= state.unknown
        if settings.expression_prior is None:
            own = torch.eye(count, dtype=torch.float64) / settings.expression_ridge**2
            each, pull = own.expand(len(weights), -1, -1), torch.full_like(weights, 1 / settings.expression_mean)
        else:
            energy = settings.expression_prior.energy(weights)
            each, pull = energy.H.expand(len(weights), -1, -1), energy.f + settings.sparsity
        if self.twins is not None and len(self.twins):
            rows = torch.arange(len(self.twins))
            apart = torch.zeros(len(self.twins), count, dtype=torch.float64)
            apart[rows, self.twins[:, 0]], apart[rows, self.twins[:, 1]] = 1.0, -1.0
            each = each + apart.T @ apart / settings.asymmetry**2
        linear[k:] = pull.flatten()
        precision[k:, k:] = torch.block_diag(*each)
        return precision, linear


@dataclass(frozen=True, eq=False)
class State:
    """Where the solve stands."""

    coefficients: Tensor  # (D,)
    views: Views
    rows: Tensor  # which point each landmark is, (I,68)
    noise: float  # of an inner landmark, pixels
    unknown: float = 1.0  # the variance of differences that the head model does not know, in what is expected of them


def whitening(problem: Problem, state: State, picked: PickedPoints) -> Whitening:
    """What makes errors unit and independent: the contour's by whether they lie along or across it."""
    settings = problem.settings
    factors = torch.eye(2, dtype=torch.float64).repeat(*problem.seen.shape, 1, 1)
    line = state.views.pixels(picked.at(state.coefficients[problem.rows]))[:, :JAW]
    along = torch.cat([line[:, 1:2] - line[:, :1], line[:, 2:] - line[:, :-2], line[:, -1:] - line[:, -2:-1]], dim=1)
    along = torch.nn.functional.normalize(along, dim=-1)
    tangent = along[..., :, None] * along[..., None, :]
    factors[:, :JAW] -= (1 - settings.contour_slide) * tangent
    factors[:, :JAW] /= settings.inner_weight**0.5
    if settings.deviations is not None:
        factors /= _relative(settings.deviations, settings.surface)[..., None, None]
    scale = problem.seen / (state.noise * _scales(problem, state.views))[:, None]
    return Whitening(factors * scale[..., None, None], problem.mixing)


def _typical(deviations: Tensor) -> Tensor:
    """The median of each view's deviations (I,68), (I,1)."""
    known = torch.where(deviations.isfinite(), deviations.double(), torch.nan)
    return known.nanmedian(1, keepdim=True).values


def _relative(deviations: Tensor, surface: SurfacePoints | None) -> Tensor:
    """Deviations (I,68) of landmarks beside the median of their view, and those of a surface, (I,68+P)."""
    typical = _typical(deviations)
    landmarks = (deviations.double() / typical).nan_to_num(_MOST, _MOST).clamp(_LEAST, _MOST)
    if surface is None:
        return landmarks
    landmarks[:, BROWS] *= _BROWS_GROW
    landmarks[:, LIPS] *= _LIPS_HOLD
    points = (_STATED_POINTS / _STATED_68) * surface.deviations.double() / typical
    return torch.cat([landmarks, points.nan_to_num(_FAR, _FAR).clamp(_LEAST, _FAR)], dim=1)


def _scales(problem: Problem, views: Views) -> Tensor:
    """How large each view's noise is beside the mean view's, (I,): as the face, where it is not given in pixels."""
    size = views.intrinsics[:, 0, 0] / views.translation[:, 2]
    return size / size.log().mean().exp() if problem.settings.noise is None else torch.ones_like(size)


def step_focal(problem: Problem) -> Tensor:
    """How the unknowns of focal length, F of them, act on the views, (I,F)."""
    count, settings = len(problem.found), problem.settings
    if settings.focal_deviation == 0:
        return torch.zeros(count, 0, dtype=torch.float64)
    if settings.shared_focal:
        return torch.ones(count, 1, dtype=torch.float64)
    return torch.eye(count, dtype=torch.float64)
