"""An active appearance model of one person: landmarks refined until the face looks as it was seen to look."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, get_args

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from torchface.color_space import grey_images
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.landmarks.images.appearance.appearance_level import AppearanceLevel, sample_pixels
from torchface.landmarks.images.appearance.dense_features import CHANNELS, Features, dense_features
from torchface.landmarks.images.appearance.face_warp import with_forehead
from torchface.landmarks.images.appearance.shape_modes import PlanarPose, planar_pose
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.number_checks import as_real
from torchface.optim.data_dependent import data_dependent
from torchface.optim.full_precision import full_precision
from torchface.optim.prepared_tensors import Prepared
from torchface.progress import Progress, silent

_MARGIN = 0.15
_MAX_SAMPLES = 8
_ASTRAY = 4.0  # times the lowest energy: steps that have come to this lead nowhere
_STILL = 0.05  # pixels of a level: a face whose landmarks move by less has arrived


@dataclass(frozen=True)
class AppearanceSettings:
    """How an appearance model is made and fitted.

    Args:
        features: what of the image is compared.
        resolutions: pixels that a face's size (the landmarks' root mean square distance from their centre) is given,
            a number a level, coarse first; a face is 2.6 sizes wide.
        spacing: pixels between the places at which textures are compared.
        iterations: steps a level.
        reach: distance over which parts of the face move together, in sizes.
        flexibility: how far each landmark may move as it never did in training, in sizes.
        variance_kept: share of the shapes' variance that the modes kept carry.
        shape_weight: how many neighbouring places count as one: weighs the shape's prior against the texture.
        jaw_margin: how far beyond the jaw line textures reach, in parts of its distance from the nose.
        parts: upper and lower face each have texture modes of their own.
        mirror: learn from every image's mirror image too.

    Example:
        >>> AppearanceSettings.of({"resolutions": [16.0]}) == AppearanceSettings(resolutions=(16.0,))  # as in files
        True
    """

    features: Features = "oriented_gradients"
    resolutions: tuple[float, ...] = (16.0, 32.0)
    spacing: float = 1.5
    iterations: int = 10
    reach: float = 0.8
    flexibility: float = 0.02
    variance_kept: float = 0.99
    shape_weight: float = 80.0
    jaw_margin: float = 0.05
    parts: bool = True
    mirror: bool = False

    def __post_init__(self) -> None:
        if self.features not in get_args(Features):
            known = ", ".join(get_args(Features))
            raise NameMismatchError(f"features: found {self.features!r}, expected one of {known}")
        if not self.resolutions or not all(4 <= one <= 256 for one in self.resolutions):
            raise ValueRangeError(f"resolutions: found {self.resolutions}, expected numbers from 4 to 256")
        limits = {
            "spacing": (0.5, 16.0),
            "iterations": (1, 1000),
            "reach": (0.05, 1e6),
            "flexibility": (0.0, 1.0),
            "variance_kept": (0.01, 1.0),
            "shape_weight": (1e-6, 1e9),
            "jaw_margin": (0.0, 0.5),
        }
        for name, (least, most) in limits.items():
            if not least <= getattr(self, name) <= most:
                raise ValueRangeError(f"{name}: found {getattr(self, name)}, expected {least} to {most}")

    @classmethod
    def of(cls, settings: "AppearanceSettings | dict[str, Any] | None") -> "AppearanceSettings":
        """Settings from what a file holds."""
        if settings is None or isinstance(settings, AppearanceSettings):
            return settings or cls()
        return cls(**{**settings, "resolutions": tuple(settings["resolutions"])})


class AppearanceFit(NamedTuple):
    """Refined landmarks.

    Args:
        landmarks: pixels, (B,68,2); NaN where the initial guess is.
        error: how badly the face there looks like the person, (B,); about 1 on frames like those learned from.
        initial_error: the same at the initial guess.
    """

    landmarks: Tensor
    error: Tensor
    initial_error: Tensor


class _LinearMaps(NamedTuple):
    """What is linear in the landmarks: the points that textures hang on (P,68), and how they change a unit of the mean
    shape along x and y round each landmark (2,68,68)."""

    points: Tensor
    steps: Tensor


class FaceCrop(NamedTuple):
    """Features (B,C,h,w) of upright images of faces, and the similarities from their pixels to the image's."""

    features: Tensor
    pose: PlanarPose


class AppearanceModel(nn.Module):
    """Moves landmarks to where the face looks as the model's person can look.

    A shape of the 68 landmarks (similarity and modes), a texture between them (mean and modes), compared at several
    resolutions, coarse first, by the fast simultaneous inverse compositional algorithm; see ``AppearanceLevel``.

    Args:
        shape_modes: K, of the shape.
        places: of each resolution's texture.
        texture_modes: of each resolution.
        triangles: T, between the landmarks.
        settings: see ``AppearanceSettings``.

    Source: thesis 4.2.2; Tzimiropoulos and Pantic 2013.
    """

    mean_shape: Tensor
    motions: Tensor
    deviations: Tensor
    triangles: Tensor

    def __init__(
        self,
        shape_modes: int,
        places: Sequence[int],
        texture_modes: Sequence[int],
        triangles: int,
        settings: AppearanceSettings | dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.settings = AppearanceSettings.of(settings)
        levels = len(self.settings.resolutions)
        if not len(places) == len(texture_modes) == levels:
            raise ShapeError(f"appearance: found {len(places)} and {len(texture_modes)} levels, expected {levels}")
        channels = CHANNELS[self.settings.features]
        self._maps: Prepared[_LinearMaps] = Prepared()
        self.register_buffer("mean_shape", torch.zeros(COUNT, 2))
        self.register_buffer("motions", torch.zeros(4 + shape_modes, COUNT, 2))
        self.register_buffer("deviations", torch.ones(shape_modes))
        self.register_buffer("triangles", torch.zeros(triangles, 3, dtype=torch.int64))
        self.levels: Any = nn.ModuleList(
            AppearanceLevel(count, channels, modes, 4 + shape_modes)
            for count, modes in zip(places, texture_modes, strict=True)
        )

    @classmethod
    def fit(
        cls,
        images: Sequence[Tensor],
        landmarks: Tensor,
        settings: AppearanceSettings | None = None,
        progress: Progress | None = None,
    ) -> "AppearanceModel":
        """Learns a person from some annotated frames, fifteen or so that span what the face does.

        Args:
            images: (H,W) or (3,H,W), uint8, or floats in [0,1]; sizes may differ.
            landmarks: (M,68,2) pixels.
            settings: how.
            progress: called with each step and how far it is.

        Raises:
            ShapeError: images and landmarks do not fit each other, or fewer than three images.
            ValueRangeError: a landmark is NaN, infinite or far outside its image, or all faces look the same.
        """
        from torchface.landmarks.images.appearance.appearance_training import learn_appearance

        return learn_appearance(images, landmarks, settings or AppearanceSettings(), progress or silent)

    @property
    def config(self) -> dict[str, Any]:
        """What the constructor needs: plain values only."""
        settings = asdict(self.settings)
        return {
            "shape_modes": len(self.deviations),
            "places": [len(level.corner) for level in self.levels],
            "texture_modes": [len(level.modes) for level in self.levels],
            "triangles": len(self.triangles),
            "settings": {**settings, "resolutions": list(settings["resolutions"])},
        }

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> "AppearanceModel":
        """A model of zeros for the state to be loaded into."""
        return cls(**config)

    def check_state(self) -> None:
        """Refuses a state that could not have been learned.

        Raises:
            ValueRangeError: an index that points nowhere, or a deviation that is not positive.
        """
        points = with_forehead(self.mean_shape[None]).shape[1]
        for indices in (self.triangles, *(level.corner for level in self.levels)):
            if bool(((indices < 0) | (indices >= points)).any()):
                raise ValueRangeError(f"appearance: found a corner outside 0 to {points - 1}, expected a landmark")
        positive = [self.deviations, *(one for level in self.levels for one in (level.noise, level.typical))]
        if not all(bool((one > 0).all()) for one in positive):
            raise ValueRangeError("appearance: found a deviation or noise of 0 or below, expected positive ones")
        if not all(4 <= float(level.scale) <= 256 for level in self.levels):
            raise ValueRangeError("appearance: found a level's scale outside 4 to 256 pixels")
        size = self.mean_shape.square().sum(1).mean().sqrt()
        if not (0.9 < float(size) < 1.1 and float(self.mean_shape.abs().max()) < 8):
            raise ValueRangeError(f"appearance: found a mean shape of size {float(size):.3g}, expected 1")

    def forward(self, images: Tensor, initial: Tensor) -> Tensor:
        """Refined landmarks (B,68,2) of images (B,1|3,H,W) in [0,1] from an initial guess (B,68,2)."""
        return self.refine(images, initial).landmarks

    def refine(self, images: Tensor, initial: Tensor) -> AppearanceFit:
        """Refined landmarks, and how well they fit before and after.

        A face whose initial guess has a NaN comes back as NaN, its errors infinite.

        Args:
            images: (B,1,H,W) or (B,3,H,W) in [0,1].
            initial: (B,68,2) pixels, wrong by at most about a tenth of the eyes' distance.

        Raises:
            ShapeError: images or initial guess of another shape.
        """
        grey, initial = self._grey(images), as_real(initial, "initial")
        if initial.shape != (len(grey), COUNT, 2):
            raise ShapeError(f"initial: found {tuple(initial.shape)}, expected {(len(grey), COUNT, 2)}")
        return self._refined(grey, initial)

    @data_dependent("to keep the model and export what finds its initial guess")
    def _refined(self, grey: Tensor, initial: Tensor) -> AppearanceFit:
        refined = torch.full_like(initial, torch.nan)
        before, after = (initial.new_full((len(initial),), torch.inf) for _ in range(2))
        usable = torch.isfinite(initial).flatten(1).all(1) & (initial.flatten(1).std(1) > 0)
        if usable.any():
            crops, points = grey[usable], initial[usable].to(self.mean_shape)
            first = points
            for level in self.levels:
                crop = self.crop(crops, points, float(level.scale))
                points = crop.pose.apply(self._refine_level(level, crop, crop.pose.undo(points)))
            # Both in the last crop: what is compared has been seen alike, and was computed once.
            before[usable] = self._error_in(crop, first).to(initial)
            after[usable] = self._error_in(crop, points).to(initial)
            refined[usable] = points.to(initial)
        return AppearanceFit(refined, after, before)

    @full_precision
    def error(self, images: Tensor, landmarks: Tensor) -> Tensor:
        """How badly faces at these landmarks (B,68,2) look like the person, (B,), at the finest resolution."""
        points = landmarks.to(self.mean_shape)
        return self._error_in(self.crop(self._grey(images), points, float(self.levels[-1].scale)), points)

    def crop(self, images: Tensor, landmarks: Tensor, resolution: float) -> FaceCrop:
        """Upright images of faces, as features: of grey images (B,1,H,W) and landmarks (B,68,2) in pixels,
        ``resolution`` pixels a unit of the mean shape."""
        low, high = self._extent()
        pose = planar_pose(self.mean_shape, landmarks)
        # From the crop's pixels: by its corner and resolution to units, then by the face's pose to the image.
        corner = torch.view_as_complex(low.contiguous())
        pose = PlanarPose(pose.rotation / resolution, pose.translation + pose.rotation * corner)
        width, height = ((high - low) * resolution).ceil().long().tolist()
        # Several samples a pixel where the image is finer than the crop: skipping pixels would alias.
        samples = pose.scale.round().long().clamp(1, _MAX_SAMPLES)
        crops = images.new_empty(len(images), 1, height, width)
        for count in samples.unique().tolist():
            rows = samples == count
            some = PlanarPose(pose.rotation[rows], pose.translation[rows])
            crops[rows] = _cut_out(images[rows], some, (width, height), count)
        return FaceCrop(dense_features(crops, self.settings.features), pose)

    def _grey(self, images: Tensor) -> Tensor:
        if not images.is_floating_point():
            raise ShapeError(f"images: found {images.dtype}, expected floats in [0,1]")
        return grey_images(images.to(self.mean_shape))

    def _error_in(self, crop: FaceCrop, landmarks: Tensor) -> Tensor:
        level = self.levels[-1]
        return level.error(level.residual(level.sample(crop.features, self._points(crop.pose.undo(landmarks)))))

    def _refine_level(self, level: AppearanceLevel, crop: FaceCrop, initial: Tensor) -> Tensor:
        """The best landmarks, by residual and shape, of an initial guess and what its steps lead to; crop pixels."""
        points = best = initial
        state = self._shape(points)[1]
        lowest = points.new_full((len(points),), torch.inf)
        precision = torch.cat([self.deviations.new_zeros(4), self.deviations.pow(-2)])
        terms = level.curvature_terms()
        still = torch.zeros_like(lowest, dtype=torch.bool)
        for iteration in range(self.settings.iterations + 1):
            residual = level.residual(level.sample(crop.features, self._points(points)))
            energy = residual.left.square().sum((1, 2)) / level.noise + (precision * state.square()).sum(1)
            better = energy < lowest
            best = torch.where(better[:, None, None], points, best)
            lowest = torch.where(better, energy, lowest)
            still = still | ~(energy < _ASTRAY * lowest)
            if iteration == self.settings.iterations or still.all():
                break
            moved = (level.step(residual, state, precision, terms) @ self.motions.flatten(1)).view_as(points)
            warp = self._linear_parts(points)
            pose, shape = self._shape(points - (warp * moved[:, :, None]).sum(3))
            ahead = self._landmarks(pose, shape)
            size = pose.scale / level.scale  # of about 1 for faces in a crop
            still = still | ~(torch.isfinite(ahead).flatten(1).all(1) & (size > 0.5) & (size < 2))
            ahead = torch.where(still[:, None, None], points, ahead)
            state = torch.where(still[:, None], state, shape)
            still = still | ((ahead - points).flatten(1).abs().amax(1) < _STILL)
            points = ahead
        return best

    def _points(self, landmarks: Tensor) -> Tensor:
        return self._linear_maps().points @ landmarks

    def _extent(self) -> tuple[Tensor, Tensor]:
        """Corners (2,) of what a crop shows, in units of the mean shape."""
        points = self._points(self.mean_shape[None])[0]
        low, high = points.amin(0), points.amax(0)
        return low - _MARGIN * (high - low), high + _MARGIN * (high - low)

    def _shape(self, landmarks: Tensor) -> tuple[PlanarPose, Tensor]:
        """Pose and state (B,Q) of landmarks (B,68,2)."""
        pose = planar_pose(self.mean_shape, landmarks)
        offset = pose.undo(landmarks) - self.mean_shape
        state = offset.flatten(1) @ self.motions[4:].flatten(1).T
        return pose, torch.cat([state.new_zeros(len(state), 4), state], dim=1)

    def _landmarks(self, pose: PlanarPose, state: Tensor) -> Tensor:
        """Landmarks (B,68,2) of faces with a pose and a state (B,Q)."""
        return pose.apply(self.mean_shape + (state @ self.motions.flatten(1)).unflatten(1, (COUNT, 2)))

    def _linear_parts(self, landmarks: Tensor) -> Tensor:
        """What the warp from the mean shape does to small steps at each landmark, (B,68,2,2).

        The mean over the triangles round it, by their size: composing with the template's inverse motion moves a
        landmark by this times the motion.

        Source: Matthews and Baker 2004, section 4.3.
        """
        steps = self._linear_maps().steps.flatten(0, 1) @ landmarks
        return steps.unflatten(1, (2, COUNT)).permute(0, 2, 3, 1)

    def _linear_maps(self) -> _LinearMaps:
        """Kept until the state changes."""

        def made() -> _LinearMaps:
            units = torch.zeros(COUNT, COUNT, 2).to(self.mean_shape)
            units[..., 0] = torch.eye(COUNT)
            points = with_forehead(units, self.settings.jaw_margin)[..., 0].T.contiguous()
            return _LinearMaps(points, self._warp_steps(units)[:, :, 0].permute(2, 1, 0).contiguous())

        return self._maps.get((self.mean_shape, self.triangles), made)

    def _warp_steps(self, landmarks: Tensor) -> Tensor:
        """See :meth:`_linear_parts`: linear in the landmarks."""
        mean = with_forehead(self.mean_shape[None], self.settings.jaw_margin)
        edges = _edges(mean, self.triangles)
        area = torch.linalg.det(edges)[0].abs()
        sound = area > 1e-3 * area.max()
        edges = torch.where(sound[:, None, None], edges, torch.eye(2).to(edges))
        parts = _edges(with_forehead(landmarks, self.settings.jaw_margin), self.triangles) @ torch.linalg.inv(edges)
        share = area * sound
        total = parts.new_zeros(len(parts), mean.shape[1], 2, 2)
        weights = share.new_zeros(mean.shape[1])
        for corner in self.triangles.unbind(1):
            total = total.index_add(1, corner, parts * share[:, None, None])
            weights = weights.index_add(0, corner, share)
        return (total / weights[:, None, None])[:, :COUNT]


def _cut_out(images: Tensor, pose: PlanarPose, size: tuple[int, int], samples: int) -> Tensor:
    """Images (B,1,height,width) whose pixels lie where a pose puts them, each a mean over ``samples`` a side."""
    x, y = ((torch.arange(count * samples).to(images) + 0.5) / samples - 0.5 for count in size)
    cos, sin = pose.rotation.real[:, None, None], pose.rotation.imag[:, None, None]
    right, down = pose.translation.real[:, None, None], pose.translation.imag[:, None, None]
    places = torch.stack([cos * x + (right - sin * y[:, None]), sin * x + (down + cos * y[:, None])], dim=-1)
    return avg_pool2d(sample_pixels(images, places.flatten(1, 2)).unflatten(2, (len(y), len(x))), samples)


def _edges(points: Tensor, triangles: Tensor) -> Tensor:
    corners = points[:, triangles]
    return torch.stack([corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]], dim=-1)
