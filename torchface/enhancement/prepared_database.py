"""Values computed once of an actor's database: filters, projections, the learned map, timing."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchface.enhancement.detail.frame_encoder import Encoder, make_encoder
from torchface.enhancement.detail.low_pass import LowPass, vertex_areas
from torchface.enhancement.enhancement_settings import EnhancementSettings
from torchface.enhancement.matching.face_regions import Regions, surface_distances
from torchface.enhancement.matching.learned_map import LearnedMap
from torchface.enhancement.matching.region_projection import RegionProjection
from torchface.enhancement.timing.actor_timing import ActorTiming
from torchface.geometry.meshes.operators import triangle_areas

_WAVELENGTH = 8.0  # millimetres: lids are placed by longer waves, shorter ones are their wrinkles
_SOFT = 6.0  # millimetres inside an eye's region in which its lids become those of the input
_ALIKE, _UNLIKE = 0.25, 0.37  # of what lids move: how far the input's are off those found at which they are, are not
_SMOOTHED, _WHOLE = 0.92, 0.97  # of the detail found: how much of it an input shows that was smoothed, that was not
_OTHER, _SAME = 0.7, 0.85  # the correlation with it of an input's detail at which that is another, is the same


@dataclass(frozen=True, eq=False)
class _Eye:
    """One eye's vertices (E,), how much each is of the lids (E,), and the filter of their surface."""

    ids: Tensor
    weights: Tensor
    low_pass: LowPass


class InputLids:
    r"""Puts an input's own lids into enhanced frames where both are nearly the same.

    Lids move far over little skin, so the smooth part of a blink is half open, and detail has to close it. A blend of
    lids closes them nearly, but seldom wholly. With :math:`x` the enhanced lids, :math:`\ell` their smooth part and
    :math:`a` the input's, the input shows lids of its own where :math:`|a - x|` is small beside :math:`|x - \ell|`;
    there the long waves of :math:`a - x` are added, and wrinkles stay. An input that was smoothed itself is always off
    by a third and more: its lids are those found. Lids that hardly move are off by as much as they move; they are the
    input's where its whole face shows the detail found: :math:`\langle a - \ell, x - \ell \rangle / |x - \ell|^2` by
    area is near 1 and the two correlate. A face that was smoothed shows less.
    """

    def __init__(self, neutral: Tensor, faces: Tensor, eyes: Tensor) -> None:
        self._eyes = [_eye(neutral, faces, inside) for inside in eyes if bool(inside.any())]
        self._areas = vertex_areas(neutral, faces)[:, None]

    def __call__(self, enhanced: Tensor, low: Tensor, own: Tensor) -> Tensor:
        """Enhanced frames (T,V,3) with the lids of ``own``; all of one place, ``low`` the smooth part."""
        if not self._eyes:
            return enhanced
        unsmoothed = self._unsmoothed(enhanced - low, own - low)
        for eye in self._eyes:
            moved, off = ((one - other)[:, eye.ids] for one, other in ((enhanced, low), (own, enhanced)))
            weights = eye.weights.to(enhanced)[:, None]
            size, error = ((weights * some.square()).sum((1, 2)) for some in (moved, off))
            ratio = (error / size.clamp(min=1e-12)).clamp(min=1e-12).sqrt()
            trusted = torch.maximum(((_UNLIKE - ratio) / (_UNLIKE - _ALIKE)).clamp(0, 1), unsmoothed)
            enhanced = enhanced.index_add(1, eye.ids, trusted[:, None, None] * weights * eye.low_pass(off))
        return enhanced

    def _unsmoothed(self, found: Tensor, shown: Tensor) -> Tensor:
        """How much the detail that an input shows is that found, and not what smoothing has left of it, (T,)."""
        areas = self._areas.to(found)
        product, whole, own = (
            (areas * one * other).sum((1, 2)).clamp(min=1e-12)
            for one, other in ((found, shown), (found, found), (shown, shown))
        )
        alike = (product / (whole * own).sqrt() - _OTHER) / (_SAME - _OTHER)
        return ((product / whole - _SMOOTHED) / (_WHOLE - _SMOOTHED)).clamp(0, 1) * alike.clamp(0, 1)


def _eye(neutral: Tensor, faces: Tensor, inside: Tensor) -> _Eye:
    ids, own = faces[inside].unique(return_inverse=True)
    own = own.view(-1, 3)
    points = neutral[ids]
    edge = torch.isin(ids, faces[~inside]).nonzero()[:, 0]
    deep = torch.ones(len(ids))
    if len(edge):
        deep = (surface_distances(points, own, edge, _SOFT).float() / _SOFT).clamp(max=1)
    return _Eye(ids, 0.5 - 0.5 * torch.cos(math.pi * deep), LowPass(points, own, _WAVELENGTH))


@dataclass(frozen=True, eq=False)
class PreparedDatabase:
    """An actor's database with what is computed of it; each part is made when it is first asked for."""

    neutral: Tensor  # (V,3), millimetres
    faces: Tensor
    patches: Tensor  # the patch of each triangle, (F,) int64
    sequences: Tensor  # the number of each frame's sequence, (K,) int64
    features: Tensor  # of the frames' patches, (K,P,9)
    coefficients: Tensor  # of the frames' details, (K,r)
    regions: Regions
    settings: EnhancementSettings  # how frames are split and detail is found

    @property
    def inputs(self) -> tuple[Tensor | float, ...]:
        """All that the parts depend on and that may change."""
        tensors = self.neutral, self.faces, self.patches, self.sequences, self.features, self.coefficients
        return *tensors, self.regions.weights, self.settings.wavelength, self.settings.temporal

    @cached_property
    @torch.no_grad()
    def encoder(self) -> Encoder:
        """What splits frames, and encodes their detail."""
        return make_encoder(self.neutral, self.faces, self.patches, self.settings.wavelength, self.settings.detail)

    @cached_property
    @torch.no_grad()
    def vertex_weights(self) -> Tensor:
        """The share of each region in each vertex, (R,V)."""
        return self.regions.vertex_weights(self.faces, len(self.neutral))

    @cached_property
    @torch.no_grad()
    def patch_weights(self) -> Tensor:
        """The share of each patch in each region, (R,P)."""
        return self.regions.patch_weights(self.patches, triangle_areas(self.neutral, self.faces))

    @cached_property
    @torch.no_grad()
    def projection(self) -> RegionProjection:
        """What finds each region's blend of the database for a coarse frame."""
        # In double precision: the learned map multiplies what frames have beyond the database.
        return RegionProjection(self.features.double(), self.patch_weights, temporal=self.settings.temporal)

    @cached_property
    @torch.no_grad()
    def learned_map(self) -> LearnedMap:
        """What is added to the blend where frames lie beyond the database."""
        return LearnedMap(self.projection, self.coefficients)

    @cached_property
    @torch.no_grad()
    def timing(self) -> ActorTiming:
        """How the actor moves between two poses, by region."""
        return ActorTiming(self.features, self.sequences, self.patch_weights, self.settings.fps)

    @cached_property
    @torch.no_grad()
    def lids(self) -> InputLids:
        """What puts the input's lids into enhanced frames."""
        eyes = [number for number, name in enumerate(self.regions.names) if name.startswith("eye")]
        return InputLids(self.neutral, self.faces, self.regions.weights[eyes] == 1)
