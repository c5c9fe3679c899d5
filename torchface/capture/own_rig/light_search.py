"""The search for a light source: directions all round, then Gauss-Newton with the strengths eliminated."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.own_rig.skin_samples import SeenSkin
from torchface.color_space import to_srgb
from torchface.rendering.point_light import MAX_DISTANCE

_DARKEST = 0.01  # linear; below, noise of the camera and not its coding decides
_LEAST_WIDTH = 3.0 / 255  # sRGB; a few steps of the file are no outlier
_WIDTH = 2.5  # medians of the residuals; some 3.7 deviations of normal noise in three channels
_STARTS, _KEPT, _APART = 100, 3, 30.0  # directions tried, refined, and degrees between those
_FEW = 700  # vertices; enough to find good directions
_USUAL = 1000.0  # millimetres at which sources are looked for first
_NEAREST = 250.0  # millimetres; nearer, a source would be in the image, and soft light would pass for such a one
_MAX_GLOSS = 0.3  # beside the source's strength; more would be a mirror, and could pass for light from the front
_SHININESS = 16.0  # Blinn's exponent; skin under a soft source
_NARROWING = (1.0, 0.5)
_ROUNDS, _ROUNDS_NEAR, _STEPS, _DONE = 10, 3, 20, 1e-4


@dataclass(frozen=True, eq=False)
class LightSource:
    """A unit direction (3,) from the middle of what was seen, and the inverse of the distance from there, 1/mm."""

    direction: Tensor
    nearness: float

    def position(self, centre: Tensor) -> Tensor:
        """In the frame of the centre, (3,), millimetres."""
        return centre + self.direction / self.nearness


@dataclass(frozen=True, eq=False)
class SourceFit:
    """A source and what comes with it."""

    source: LightSource  # where it stands
    factors: Tensor  # of the columns, none negative, (3,3)
    lit: Tensor  # 1 where the source reaches, else 0, (Q,)
    # how vertices look under ambient light, under the source without gloss, and with all the gloss that skin has,
    # (3,Q,3)
    columns: Tensor
    residuals: Tensor  # shaded albedo minus frame, sRGB, (Q,3); 0 where blown out
    trust: Tensor  # robust weight of each vertex, in (0,1], (Q,)
    cost: float

    @property
    def ambient(self) -> Tensor:
        """Strength of the light from everywhere, linear, (3,)."""
        return self.factors[0]

    @property
    def intensity(self) -> Tensor:
        """Strength of the source, (3,)."""
        return self.factors[1] + self.factors[2]

    @property
    def gloss(self) -> Tensor:
        """Strength of its highlights, (3,)."""
        return _MAX_GLOSS * self.factors[2]


def find_source(seen: SeenSkin) -> SourceFit:
    """The source that explains best what was seen; see ``estimate_light``."""
    starts, width = _starts(seen.thinned(_FEW))
    fits = [_settled(seen, start, width) for start in starts]  # a few; each casts its own shadows
    return min(fits, key=lambda one: (_width(one.residuals, seen), one.cost))


def information(seen: SeenSkin, fit: SourceFit) -> Tensor:
    """Curvature of the objective over two angles across the direction (radians) and the nearness, (3,3)."""
    return _normal_equations(seen, fit)[0]


def _starts(seen: SeenSkin) -> tuple[list[SourceFit], float]:
    """The best of directions all round, some degrees apart, and the robust estimator's width at the very best."""
    number = torch.arange(_STARTS, dtype=torch.float64)
    z = 1 - 2 * (number + 0.5) / _STARTS
    azimuth = number * math.pi * (3 - math.sqrt(5))
    directions = torch.stack([(1 - z * z).sqrt() * azimuth.cos(), (1 - z * z).sqrt() * azimuth.sin(), z], dim=1)
    sources = [LightSource(direction, 1 / _USUAL) for direction in directions]
    tried = [_with_factors(seen, source) for source in sources]  # a source at a time: each casts its own shadows
    width = min(_width(one.residuals, seen) for one in tried)
    costs = torch.tensor([_cost(one.residuals, seen, width) for one in tried])
    chosen: list[int] = []
    for i in costs.argsort().tolist():
        if all(float(directions[i] @ directions[j]) < math.cos(math.radians(_APART)) for j in chosen):
            chosen.append(i)
    return [tried[i] for i in chosen[:_KEPT]], width


def _settled(seen: SeenSkin, start: SourceFit, width: float) -> SourceFit:
    """Refined with an estimator that narrows, so that a large foreign shadow lets go; at last as wide as what is left.

    What is left at the median, not the objective, then says which start was right: each has its own outliers.
    """
    for share in _NARROWING:
        start = _refined(seen, start, max(share * width, _LEAST_WIDTH))
    return _refined(seen, start, min(width, _width(start.residuals, seen)))


def _refined(seen: SeenSkin, start: SourceFit, width: float) -> SourceFit:
    """Levenberg's steps over direction and nearness; the strengths are at their optimum all the time."""
    now, damping = _with_factors(seen, start.source, width, start.factors), 1e-3
    H, g = _normal_equations(seen, now)
    for _ in range(_STEPS):
        step = -torch.linalg.solve(H + damping * H.diagonal().clamp(min=1e-9).diag(), g)
        then = _with_factors(seen, _moved(now.source, step, 1 / MAX_DISTANCE, 1 / _NEAREST), width, now.factors)
        if then.cost >= now.cost:  # too far, or shadows that fell otherwise
            damping *= 8
            if damping > 1e4:
                break
            continue
        gain, now, damping = 1 - then.cost / now.cost, then, max(damping / 5, 1e-7)
        if gain < _DONE:
            break
        H, g = _normal_equations(seen, now)
    return now


def _moved(source: LightSource, step: Tensor, least: float, most: float) -> LightSource:
    """Across the direction by at most half a radian, and in nearness within bounds."""
    direction_step = step[:2] * min(1.0, 0.5 / max(float(step[:2].norm()), 1e-12))
    direction = torch.nn.functional.normalize(source.direction + direction_step @ _tangents(source.direction), dim=0)
    return LightSource(direction, min(max(source.nearness + float(step[2]) / _USUAL, least), most))


def _tangents(direction: Tensor) -> Tensor:
    """Two unit vectors across a direction, (2,3)."""
    aside = torch.zeros(3, dtype=torch.float64)
    aside[direction.abs().argmin()] = 1.0
    first = torch.nn.functional.normalize(torch.linalg.cross(direction, aside), dim=0)
    return torch.stack([first, torch.linalg.cross(direction, first)])


def _with_factors(
    seen: SeenSkin, source: LightSource, width: float | None = None, factors: Tensor | None = None
) -> SourceFit:
    """The best factors for a source, by reweighted least squares from some, else from plain least squares.

    Without a width the residuals themselves give one, anew in each round: from afar, most look like outliers.
    """
    lit = seen.lit_by(source.position(seen.centre)).double()
    reflected = _reflected(seen, source)
    diffuse, gloss = seen.albedo * (lit * reflected.falling)[:, None], (lit * reflected.gloss)[:, None].expand(-1, 3)
    columns = torch.stack([seen.albedo, diffuse, diffuse + _MAX_GLOSS * gloss])
    coded = to_srgb(seen.colors)
    if factors is None:
        factors = _factors(columns, seen.colors, seen.area[:, None] * seen.valid / _slope(seen.colors).square())

    def compared(factors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        shaded = (factors[:, None] * columns).sum(0)
        residuals = seen.valid * (to_srgb(shaded) - coded)
        spread = _width(residuals, seen) if width is None else width
        return shaded, residuals, (1 + residuals.square().sum(1) / spread**2).pow(-2)

    shaded, residuals, trust = compared(factors)
    for _ in range(_ROUNDS if width is None else _ROUNDS_NEAR):
        slope = _slope(shaded)
        weight = (seen.area * trust)[:, None] * seen.valid / slope.square()
        factors = _factors(columns, shaded - residuals * slope, weight)
        shaded, residuals, trust = compared(factors)
    cost = math.nan if width is None else _cost(residuals, seen, width)
    return SourceFit(source, factors, lit, columns, residuals, trust, cost)


@dataclass(frozen=True, eq=False)
class _Reflection:
    """Cosine of the falling light and Blinn's highlight at Q vertices, as if nothing threw a shadow, (Q,) each.

    ``falling_moved`` and ``gloss_moved``, (Q,3), are their derivatives by the two angles across the source's direction
    and by its nearness in units of that of the usual distance.
    """

    falling: Tensor
    gloss: Tensor
    falling_moved: Tensor
    gloss_moved: Tensor


def _reflected(seen: SeenSkin, source: LightSource) -> _Reflection:
    aside = seen.points - seen.centre
    way = source.direction - source.nearness * aside
    length = way.norm(dim=1, keepdim=True)
    toward = way / length
    between = toward - torch.nn.functional.normalize(seen.points, dim=1)
    width = between.norm(dim=1, keepdim=True).clamp(min=1e-9)
    half = between / width
    cosine, shine = (seen.normals * toward).sum(1), (seen.normals * half).sum(1).clamp(min=0)
    faces = (cosine > 0).double()

    def moved(slope: Tensor) -> Tensor:
        """By the source's place, where ``slope`` (Q,3) is by the unit vector toward it."""
        across = (slope - (slope * toward).sum(1, keepdim=True) * toward) / length
        return torch.cat(
            [across @ _tangents(source.direction).T, -(across * aside).sum(1, keepdim=True) / _USUAL], dim=1
        )

    tilt = (seen.normals - shine[:, None] * half) / width
    steep = faces * _SHININESS * shine ** (_SHININESS - 1)
    return _Reflection(
        cosine.clamp(min=0),
        faces * shine**_SHININESS,
        moved(seen.normals) * faces[:, None],
        moved(tilt) * steep[:, None],
    )


def _factors(columns: Tensor, wanted: Tensor, weight: Tensor) -> Tensor:
    """Non-negative factors (K,3) of columns (K,Q,3) with the least weighted square distance to ``wanted`` (Q,3).

    All 2^K sets of factors that are not zero are solved; the best of those without a negative factor is the answer.
    """
    H = torch.einsum("iqc,jqc,qc->cij", columns, columns, weight)
    f = torch.einsum("iqc,qc,qc->ci", columns, wanted, weight)
    scale = H.diagonal(dim1=1, dim2=2).clamp(min=1e-12).rsqrt()
    H, f = H * scale[:, :, None] * scale[:, None], f * scale
    free = torch.cartesian_prod(*[torch.tensor([0.0, 1.0], dtype=H.dtype)] * len(columns))
    eye = torch.eye(len(columns), dtype=H.dtype)
    inside = free[:, :, None] * free[:, None]
    solutions = torch.linalg.solve(inside * (H[:, None] + 1e-9 * eye) + (1 - free)[:, None] * eye, free * f[:, None])
    gain = (solutions * f[:, None]).sum(-1).masked_fill((solutions < 0).any(-1), -1.0)  # (C,2^K)
    best = solutions[torch.arange(len(solutions)), gain.argmax(1)]
    return (best * scale).T


def _normal_equations(seen: SeenSkin, fit: SourceFit) -> tuple[Tensor, Tensor]:
    """H (3,3) and g (3,) of the source's place, with the strengths' directions projected out (variable projection)."""
    reflected = _reflected(seen, fit.source)
    slope = _slope((fit.factors[:, None] * fit.columns).sum(0))
    root = (seen.valid * (seen.area * fit.trust)[:, None]).sqrt()
    H, g = torch.zeros(3, 3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    for c in range(3):  # channels: each has strengths of its own to project out
        scaled = root[:, c] / slope[:, c]
        basis = torch.linalg.qr((scaled * fit.columns[fit.factors[:, c] > 0, :, c]).T)[0]
        diffuse = (fit.intensity[c] * seen.albedo[:, c])[:, None] * reflected.falling_moved
        part = (scaled * fit.lit)[:, None] * (diffuse + fit.gloss[c] * reflected.gloss_moved)
        part = part - basis @ (basis.T @ part)
        H, g = H + part.T @ part, g + part.T @ (root[:, c] * fit.residuals[:, c])
    return H, g


def _slope(linear: Tensor) -> Tensor:
    """How much linear light changes with its sRGB code."""
    return 2.4 / 1.055 * linear.clamp(min=_DARKEST).pow(1.4 / 2.4)


def _width(residuals: Tensor, seen: SeenSkin) -> float:
    """Of the robust estimator, from the median of the residuals, every pixel counting alike."""
    sizes, order = residuals.norm(dim=1).sort()
    share = seen.area[order].cumsum(0)
    return max(_LEAST_WIDTH, _WIDTH * float(sizes[torch.searchsorted(share, share[-1:] / 2)]))


def _cost(residuals: Tensor, seen: SeenSkin, width: float) -> float:
    square = residuals.square().sum(1)
    return float((seen.area * square / (1 + square / width**2)).sum())
