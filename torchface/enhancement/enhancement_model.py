"""An actor's captured performance as a model that gives its fine detail to coarse animations."""

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchface.enhancement.captured_performance import CapturedPerformance
from torchface.enhancement.detail.detail_basis import blended
from torchface.enhancement.detail.low_pass import vertex_areas
from torchface.enhancement.enhancement_settings import DEFAULT_SETTINGS, EnhancementSettings, EnhancementSizes
from torchface.enhancement.matching.face_regions import Regions
from torchface.enhancement.prepared_database import PreparedDatabase
from torchface.errors import TopologyError, ValueRangeError
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.number_checks import MAX_FPS, MIN_FPS, as_real, checked_count, checked_number
from torchface.optim.data_dependent import data_dependent
from torchface.optim.prepared_tensors import Prepared
from torchface.progress import Progress

_NUMBERS = 2**21  # vertices of all frames that are enhanced at a time
# Of the distance from which on a frame is outside, until where a linear map is trusted: motion that the smooth part
# lacks goes on linearly, wrinkles saturate.
_REACH, _REACH_OF_WRINKLES = 2.0, 0.5
# Of that distance: a frame that goes so much further than all of the database in its own direction is outside as well.
_FURTHER = 0.5
_MOST_SCALE = 1000.0
_REGION = re.compile(r"[A-Za-z0-9_-]{1,80}")
_LARGEST = 1e6  # of any number of a state: millimetres, rotations, stretches, colours


@dataclass(frozen=True, eq=False)
class Enhancement:
    """Enhanced frames, and what they were made of.

    Args:
        vertices: (T,V,3), millimetres, in the input's place.
        weights: of the database's frames in each region, (T,R,K), of sum 1.
        distances: of the input from the nearest blend of database frames, by region, (T,R), in units of the
            database's own spread.
        outside: (T,R) bool, whether the input is further from the database than its own sequences are from another, or
            goes further than all of it in the same direction (a brow higher than any), so that its detail is a guess,
            and far from it but the nearest.
    """

    vertices: Tensor
    weights: Tensor
    distances: Tensor
    outside: Tensor


class EnhancementModel(nn.Module):
    r"""Gives coarse animations of a dense head the wrinkles, creases and colours of a captured actor.

    A frame a is aligned with the neutral and split, :math:`\ell = d_0 + \mathrm{LowPass}(a - d_0)`. The deformation
    gradients of :math:`\ell`, in the mean over patches, are projected by region onto convex combinations of the
    database's; the same combinations of the database's details, blended over the regions' soft borders, go onto
    :math:`\ell` in the place of what a itself had beyond it; lids that a shows itself stay, see ``InputLids``.

    Args:
        sizes: of what it holds.
        region_names: of the R regions.
        voluntary: whether the actor moves each at will.
        settings: how frames are split and detail is found.
        lost_share: of the details' energy, by their compression.
        keeps_input: whether detail goes onto the coarse frames themselves and not onto their smooth part.
        scale: how much of what is added to the coarse frames, see :meth:`on_actor`.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, sections 4 and 5. Changed: the filter
    works on displacements, alignment and averages by patches; detail is of low rank.

    Example:
        >>> from torchface.enhancement import CapturedPerformance
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> smiles = rig.index(["mouthSmileLeft", "mouthSmileRight"])
        >>> weights = rig.vertices.new_zeros(12, len(rig.names))
        >>> weights[:, smiles] = torch.linspace(0, 1, 6).repeat(2)[:, None].to(weights)
        >>> takes = torch.arange(2).repeat_interleave(6)  # two sequences from rest to a smile
        >>> frames, faces = rig(weights), rig.neutral.faces
        >>> performance = CapturedPerformance(frames, faces, takes, rig.vertices)
        >>> model = EnhancementModel.fit(performance, patch_size=200, region_count=2)
        >>> bool((model(frames[3:4]) - frames[3:4]).norm(dim=-1).mean() < 0.1)  # what was captured comes back
        True
    """

    neutral: Tensor
    faces: Tensor
    patches: Tensor
    region_weights: Tensor
    sequences: Tensor
    database_features: Tensor
    components: Tensor
    coefficients: Tensor
    mean_color: Tensor
    color_components: Tensor
    color_coefficients: Tensor
    limits: Tensor
    map_shares: Tensor

    def __init__(
        self,
        sizes: EnhancementSizes,
        region_names: Sequence[str],
        voluntary: Sequence[bool],
        settings: EnhancementSettings = DEFAULT_SETTINGS,
        lost_share: float = 0.0,
        keeps_input: bool = False,
        scale: float = 1.0,
    ) -> None:
        super().__init__()
        self.sizes, self.settings = sizes, settings
        self.region_names = tuple(region_names)
        self.voluntary = tuple(bool(value) for value in voluntary)
        self.lost_share = checked_number("lost_share", lost_share, 0.0, 1.0)
        self.keeps_input = bool(keeps_input)
        self.scale = checked_number("scale", scale, most=_MOST_SCALE)
        vertices, triangles, frames, regions = sizes.vertices, sizes.triangles, sizes.frames, len(self.region_names)
        self.register_buffer("neutral", torch.zeros(vertices, 3))
        self.register_buffer("faces", torch.zeros(triangles, 3, dtype=torch.int64))
        self.register_buffer("patches", torch.zeros(triangles, dtype=torch.int64))
        self.register_buffer("region_weights", torch.zeros(regions, triangles))
        self.register_buffer("sequences", torch.zeros(frames, dtype=torch.int64))
        # From which distance on a frame is outside of the database, and how much of the learned map counts.
        self.register_buffer("limits", torch.ones(regions, dtype=torch.float64))
        self.register_buffer("map_shares", torch.ones(regions, dtype=torch.float64))
        self.register_buffer("database_features", torch.zeros(frames, sizes.patches, 9))
        size = 3 * vertices if settings.detail == "displacements" else 9 * triangles
        self.register_buffer("components", torch.zeros(sizes.rank, size, dtype=torch.float16))
        self.register_buffer("coefficients", torch.zeros(frames, sizes.rank))
        color_rank, colored = sizes.color_rank, vertices if sizes.color_rank else 0
        self.register_buffer("mean_color", torch.zeros(colored, 3))
        self.register_buffer("color_components", torch.zeros(color_rank, 3 * colored, dtype=torch.float16))
        self.register_buffer("color_coefficients", torch.zeros(frames if color_rank else 0, color_rank))
        self._prepared: Prepared[PreparedDatabase] = Prepared()

    @classmethod
    def fit(
        cls,
        performance: CapturedPerformance,
        settings: EnhancementSettings = DEFAULT_SETTINGS,
        *,
        patch_size: int = 100,
        region_count: int = 13,
        rank: int = 64,
        seed: int = 0,
        folder: str | Path | None = None,
        progress: Progress | None = None,
    ) -> "EnhancementModel":
        """Learns from a captured performance; ``lost_share`` of the details' energy is what the components do not hold.

        Args:
            performance: K frames of the actor.
            settings: how frames are split and detail is found.
            patch_size: vertices a patch.
            region_count: how many regions are looked for.
            rank: components of the detail.
            seed: of patches and regions.
            folder: where a run that is killed finds what it has learned; of this run alone.
            progress: called with each step and the frames that are done.

        Raises:
            TopologyError: vertices of frames are in another order.
            ValueRangeError: NaN.
            AlignmentError: frames of another unit.
            FileFormatError: the disk is full.
        """
        from torchface.enhancement.enhancement_training import fit_enhancement

        return fit_enhancement(performance, settings, patch_size, region_count, rank, seed, folder, progress)

    @property
    def config(self) -> dict[str, Any]:
        """What :meth:`from_config` needs: plain values only."""
        return {
            **asdict(self.sizes),
            **asdict(self.settings),
            "region_names": list(self.region_names),
            "voluntary": list(self.voluntary),
            "lost_share": self.lost_share,
            "keeps_input": self.keeps_input,
            "scale": self.scale,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "EnhancementModel":
        """A model of zeros for the state to be loaded into.

        Raises:
            ValueRangeError: the config is of an earlier version.
        """
        if "scale" not in config or "limits" in config or "weight_names" in config:
            raise ValueRangeError("found a model of an earlier version, whose state was another: learn it again")
        given = dict(config)
        words, choices = list(given["region_names"]), [*given["voluntary"], given["keeps_input"]]
        if not all(isinstance(word, str) and _REGION.fullmatch(word) for word in words):  # they name files
            raise ValueRangeError("region_names: found other than letters, digits, - and _, expected these alone")
        if not all(isinstance(choice, bool) for choice in choices):
            raise ValueRangeError("voluntary or keeps_input: found neither true nor false, expected one")
        sizes = EnhancementSizes(**{size.name: given.pop(size.name) for size in fields(EnhancementSizes)})
        settings = EnhancementSettings(**{one.name: given.pop(one.name) for one in fields(EnhancementSettings)})
        return cls(sizes, settings=settings, **given)

    @property
    def regions(self) -> Regions:
        """The regions of the face."""
        return Regions(self.region_names, self.region_weights, torch.tensor(self.voluntary))

    def forward(self, coarse: Tensor) -> Tensor:
        """Enhanced frames (T,V,3) of coarse ones (T,V,3), millimetres, where they are; differentiable."""
        return self.enhance(coarse).vertices

    @data_dependent("WrinkleWeights, which `torchface export enhancement` writes")
    def enhance(self, coarse: Tensor, previous: Tensor | None = None) -> Enhancement:
        """Enhanced frames, with what they were made of.

        Args:
            coarse: (T,V,3), millimetres, in this mesh and any rigid place.
            previous: weights of the frame before, (R,K), towards which those of the first are damped.

        Raises:
            TopologyError: another number of vertices, or another order.
            AlignmentError: another unit.
            ValueRangeError: NaN or infinity.
        """
        coarse = self._checked(coarse)
        pieces, size = [], max(1, _NUMBERS // len(self.neutral))
        for begin in range(0, len(coarse), size):
            pieces.append(self._enhanced(coarse[begin : begin + size], previous))
            previous = pieces[-1].weights[-1].detach()
        if not pieces:
            regions, frames = len(self.region_names), len(self.sequences)
            none = coarse.new_zeros(0, regions)
            return Enhancement(coarse, coarse.new_zeros(0, regions, frames), none, none.bool())
        return Enhancement(*(torch.cat([getattr(piece, f.name) for piece in pieces]) for f in fields(Enhancement)))

    def features(self, coarse: Tensor) -> Tensor:
        """Rotation vector and stretch of each patch of the smooth part, (T,P,9), of frames (T,V,3)."""
        smooth, encoder = self._smooth(self._checked(coarse))[0], self.prepared.encoder
        return encoder.gradients.features(smooth, encoder.frames.turned(smooth))

    def low(self, coarse: Tensor) -> Tensor:
        """The smooth part of frames (T,V,3), aligned with the neutral."""
        coarse = self._checked(coarse)
        return self.neutral.to(coarse) + self._smooth(coarse)[0]

    def colors(self, weights: Tensor) -> Tensor:
        """Colours of the vertices, (T,V,3), for weights (T,R,K) of :meth:`enhance`.

        Raises:
            ValueRangeError: the model has learned none.
        """
        if len(self.mean_color) == 0:
            raise ValueRangeError("colors: the model has learned none; fit it with colors")
        offsets = blended(self.color_components, weights @ self.color_coefficients.to(weights), self.vertex_weights)
        return (self.mean_color.to(weights) + offsets.unflatten(1, (3, -1)).transpose(1, 2)).clamp(0, 1)

    def retime(self, keyframes: Tensor, frames: int, fps: float | None = None, extend: bool = True) -> Tensor:
        """The actor's timing of a motion between two poses, by region.

        Args:
            keyframes: (2,V,3), millimetres, in this mesh and any rigid place.
            frames: how many the motion lasts, both keyframes counted.
            fps: of these frames; the database's unless given.
            extend: time them as the whole captured motion of which they meet a part, not as that part.

        Returns:
            How far each region has come in each frame, (R,frames), 0 first and 1 last, never falling;
            ``torchface.enhancement.animation_retiming.at_moments`` makes the motion of it.

        Raises:
            TopologyError: another number of vertices, or another order.
            ValueRangeError: the keyframes are equal, fewer than two frames, or NaN.

        Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, section 6. Changed: timing is learned
        from all motions of a region where it has enough of them.
        """
        checked_count("frames", frames, 2)
        fps = self.fps if fps is None else checked_number("fps", fps, MIN_FPS, MAX_FPS)
        return self.prepared.timing.times(self.features(keyframes), frames, (frames - 1) * self.fps / fps, extend)

    def on_actor(self, neutral: Tensor, scale: float = 1.0) -> "EnhancementModel":
        """This actor's detail for another head of the same mesh, as much larger as that head is.

        Args:
            neutral: the other head, (V,3), millimetres, in any rigid place.
            scale: of the difference between enhanced and coarse frames: 0 leaves the coarse ones, whose own lids and
                lips then move as ever, 2 doubles what is added.

        Raises:
            TopologyError: another number of vertices.
        """
        scale = checked_number("scale", self.scale * checked_number("scale", scale), most=_MOST_SCALE)
        if neutral.shape != self.neutral.shape:
            raise TopologyError(f"neutral: found {tuple(neutral.shape)}, expected {tuple(self.neutral.shape)}")
        if not bool(torch.isfinite(neutral).all()):
            raise ValueRangeError("neutral: found NaN or infinite vertices, expected none")
        neutral = neutral.detach().to(self.neutral)[None]
        # Features and details have axes: those of this head.
        neutral = similarity_transform(neutral, self.neutral[None], scale=False).apply(neutral)[0]
        other = copy.deepcopy(self)
        sizes = [float(vertex_areas(head, self.faces).sum()) ** 0.5 for head in (neutral, self.neutral)]
        other.settings = replace(self.settings, wavelength=self.settings.wavelength * sizes[0] / sizes[1])
        other.coefficients = self.coefficients * (sizes[0] / sizes[1])
        other.neutral = neutral.to(self.neutral)
        other.scale = scale
        return other

    @property
    def fps(self) -> float:
        """Of the database."""
        return self.settings.fps

    @property
    def vertex_weights(self) -> Tensor:
        """The share of each region in each vertex, (R,V)."""
        return self.prepared.vertex_weights

    @property
    def map_reach(self) -> Tensor:
        """Of each region, up to what distance the learned map is trusted, (R,)."""
        return self.limits * (_REACH_OF_WRINKLES if self.keeps_input else _REACH)

    @property
    def prepared(self) -> PreparedDatabase:
        """What is computed once of the state and kept until the state changes."""
        parts = self.neutral, self.faces, self.patches, self.sequences, self.database_features, self.coefficients
        database = PreparedDatabase(*parts, self.regions, self.settings)
        return self._prepared.get(database.inputs, lambda: database)

    def check_state(self) -> None:
        """Refuses a state whose numbers do not make a model.

        Raises:
            TopologyError: a triangle or a patch is none.
            ValueRangeError: a limit or a share is out of range.
        """
        if not 0 <= int(self.faces.min()) <= int(self.faces.max()) < len(self.neutral):
            raise TopologyError(f"faces: found vertices beyond the {len(self.neutral)} there are")
        if not 0 <= int(self.patches.min()) <= int(self.patches.max()) < self.database_features.shape[1]:
            raise TopologyError(f"patches: found some beyond the {self.database_features.shape[1]} there are")
        if not bool((self.limits > 0).all()):
            raise ValueRangeError(f"limits: found {self.limits.tolist()}, expected positive ones")
        if not bool(((self.map_shares >= 0) & (self.map_shares <= 1)).all()):
            raise ValueRangeError(f"map_shares: found {self.map_shares.tolist()}, expected some of 0 to 1")
        weights = self.region_weights
        if not bool(((weights >= 0) & (weights <= 1)).all()) or not bool((weights > 0).any(1).all()):
            raise ValueRangeError("region_weights: found some beyond 0 to 1, or a region without any, expected neither")
        for name, values in self.named_buffers():
            if values.is_floating_point() and values.numel() and not float(values.abs().max()) <= _LARGEST:
                raise ValueRangeError(f"{name}: found numbers beyond {_LARGEST:g}, expected none")

    def _enhanced(self, coarse: Tensor, previous: Tensor | None) -> Enhancement:
        smooth, displacements, pose = self._smooth(coarse)
        prepared = self.prepared
        encoder = prepared.encoder
        turned = encoder.frames.turned(smooth)
        features = encoder.gradients.features(smooth, turned)
        matched = prepared.projection.project(features, previous)
        coefficients = matched.weights @ self.coefficients.to(matched.weights)
        if self.settings.matching == "learned":
            shares = self.map_shares.to(features)
            coefficients = coefficients + prepared.learned_map.corrections(features, matched, self.map_reach, shares)
        details = blended(self.components, coefficients, encoder.detail.site_weights(prepared.vertex_weights))
        low, own = (self.neutral.to(smooth) + moved for moved in (smooth, displacements))
        if self.keeps_input:
            vertices = encoder.detail.compose(own, details, turned)
        else:
            vertices = prepared.lids(encoder.detail.compose(low, details, turned), low, own)
        if self.scale != 1.0:
            vertices = own + self.scale * (vertices - own)
        limits = self.limits.to(matched.distances)
        further = False if matched.excess is None else matched.excess > _FURTHER * limits
        outside = (matched.distances > limits) | further
        return Enhancement(pose.inverse().apply(vertices), matched.weights, matched.distances, outside)

    def _smooth(self, coarse: Tensor) -> tuple[Tensor, Tensor, Similarity]:
        """The smooth part of displacements from the neutral, all of them, and how the frames were aligned with it."""
        encoder = self.prepared.encoder
        displacements, pose = encoder.alignment.aligned(coarse, "coarse")
        return encoder.low_pass(displacements), displacements, pose

    def _checked(self, coarse: Tensor) -> Tensor:
        coarse = as_real(coarse, "coarse")
        if coarse.ndim != 3 or coarse.shape[1:] != self.neutral.shape:
            raise TopologyError(
                f"coarse: found {tuple(coarse.shape)}, expected (T,{len(self.neutral)},3): frames of the model's own "
                "mesh; what is of another reaches it by a thin shell"
            )
        bad = (~torch.isfinite(coarse.detach())).any(-1).any(-1).nonzero()[:, 0]
        if len(bad):
            raise ValueRangeError(f"coarse: frame {int(bad[0])} holds NaN or infinite vertices, expected none")
        return coarse.float() if coarse.dtype in (torch.float16, torch.bfloat16) else coarse  # sparse ones know neither
