"""What is computed once of an actor's database: filters, projections, the learned map, timing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchface.enhancement.detail.frame_encoder import Encoder, make_encoder
from torchface.enhancement.enhancement_settings import EnhancementSettings
from torchface.enhancement.input_lids import InputLids
from torchface.enhancement.matching.face_regions import Regions
from torchface.enhancement.matching.learned_map import LearnedMap
from torchface.enhancement.matching.region_projection import RegionProjection
from torchface.enhancement.timing.actor_timing import ActorTiming
from torchface.geometry.meshes.operators import triangle_areas


@dataclass(frozen=True, eq=False)
class PreparedDatabase:
    """An actor's database with what is computed of it; each part is made when it is first asked for.

    Args:
        neutral: (V,3), millimetres.
        faces: (F,3) int64.
        patches: the patch of each triangle, (F,) int64.
        sequences: the number of each frame's sequence, (K,) int64.
        features: of the frames' patches, (K,P,9).
        coefficients: of the frames' details, (K,r).
        regions: of the face.
        settings: how frames are split and detail is found.
    """

    neutral: Tensor
    faces: Tensor
    patches: Tensor
    sequences: Tensor
    features: Tensor
    coefficients: Tensor
    regions: Regions
    settings: EnhancementSettings

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
        return RegionProjection(self.features, self.patch_weights, temporal=self.settings.temporal)

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
