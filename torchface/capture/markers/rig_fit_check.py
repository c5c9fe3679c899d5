"""Check that a rig explains the markers of a take; if not, the cause whose correction helps most."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.capture.markers.frame_poses import MIN_MARKERS, frame_poses
from torchface.capture.markers.helmet_motion import HelmetMotion, free_motion
from torchface.capture.markers.rest_pose import pose_of_take, solve_weights
from torchface.geometry.mirrored_points import check_mirrored
from torchface.geometry.similarity import Similarity
from torchface.io.length_units import UNITS

# Shares of the sites' mean distance from their centre, 45 to 70 mm on a head. On real takes the markers of a rig that
# fits stay within 0.009 with noise of 0.3 mm and 0.03 with 1 mm, swaps and gaps included; those of another head's rig,
# aligned to it, and markers 3 mm off the skin within 0.03. A take moved by 5 mm has 0.03, one moved by 10 mm or turned
# by 5 degrees 0.05 to 0.06, sites 2 to 8 mm wrong 0.07, a helmet that slips by 10 mm 0.09, a take moved by 20 mm 0.13,
# sites of the marker next to each 0.2, another head's attachment 0.8 to 1.3, centimetres or metres read as millimetres
# 1.4 to 1.6.
TRIED_SHARE, DOUBTFUL_SHARE, REFUSED_SHARE = 0.015, 0.035, 0.1
# Markers on the brows alone lie close together; they stand as far off the skin as those of a whole face.
_MIN_RADIUS = 40.0
# A correction names the cause if it leaves less than this part of the distance.
_CORRECTED = 0.5
_UNIT_TOLERANCE = 1.25
# Beyond this no helmet slips: half the radius of the sites, or half a radian.
_MAX_SLIP, _MAX_SLIP_ANGLE = 0.5, 0.5
_FRAMES, _RIDGE = 240, 0.01


@dataclass(frozen=True)
class FitCheck:
    """How far a rig's markers are from where it can bring their sites.

    Args:
        distance: median over all samples that were seen, millimetres of rig space; NaN where none was.
        radius: of the sites at rest, mean distance from their centre, millimetres.
        cause: what most likely is wrong: ``unit``, ``alignment``, ``mirror`` (left-handed coordinates, or sides
            swapped), ``motion`` (the head moves freely in the volume), ``slip`` (the helmet moves on the head) or
            ``attachment`` (sites, labels or rig are other ones); empty where nothing is.
        corrected: the distance without that cause, millimetres; NaN where no correction helps.
        similarity: that aligns the markers with the rig best, (1,).
        read_as: the unit that the markers were read in, where it is known.
        motion: of a head that moves freely.

    Example:
        >>> check = FitCheck(distance=60.0, radius=70.0, cause="mirror", corrected=0.4)
        >>> check.refused
        True
    """

    distance: float
    radius: float
    cause: str = ""
    corrected: float = math.nan
    similarity: Similarity | None = None
    read_as: str | None = None
    motion: HelmetMotion | None = None

    @property
    def limit(self) -> float:
        """The largest ``distance`` that is not refused, millimetres."""
        return REFUSED_SHARE * self._size

    @property
    def refused(self) -> bool:
        """The rig does not explain the markers; what would be solved is no performance."""
        return not self.distance <= self.limit

    @property
    def usual(self) -> float:
        """The largest ``distance`` that a stage's noise makes, millimetres."""
        return TRIED_SHARE * self._size

    @property
    def noisy(self) -> bool:
        """The distance is more than a stage's noise makes: worth looking for a cause."""
        return not self.distance <= self.usual

    @property
    def doubtful(self) -> bool:
        """The distance is more than noise, another head's rig or markers that stand off the skin make."""
        return not self.distance <= DOUBTFUL_SHARE * self._size

    @property
    def _size(self) -> float:
        return max(self.radius, _MIN_RADIUS)

    @property
    def unit(self) -> str:
        """What the coordinates seem to be in that were read as millimetres; ``mm`` if they are too large."""
        if self.similarity is None:
            return "mm"
        return unit_of_scale(float(self.similarity.scale[0]), self.read_as) or "mm"


def check_fit(affine: Tensor, markers: Tensor, slip: bool = False) -> FitCheck:
    """Solves some frames of a take for weights, and where markers stay far from the rig looks for the cause.

    Weights are solved with hardly a penalty, so that the distance is what the rig cannot explain. Where its median
    is more than noise, the take is aligned by one similarity, then by a rigid motion a frame; a correction that leaves
    less than half of the distance is the cause, and a scale near that of a unit makes it the unit. Markers whose mirror
    image fits clearly better are mirrored. Label swaps, spikes and markers that fell off move the median little: they
    are no cause.

    Args:
        affine: of each marker's site in the weights, (M,3,N+1), mm: at rest, then each shape's delta.
        markers: (T,M,3), in rig space as far as is known, NaN for not seen.
        slip: the helmet's motion will be taken out: it is not part of the distance.

    Returns:
        A ``FitCheck``.

    Example:
        >>> generator = torch.Generator().manual_seed(0)
        >>> sites, shapes = (torch.randn(20, 3, count, generator=generator) for count in (1, 2))
        >>> affine = torch.cat([50 * sites, shapes], -1)
        >>> check = check_fit(affine, affine[None, ..., 0].repeat(9, 1, 1) / 10)
        >>> check.cause, check.unit
        ('unit', 'cm')
    """
    affine, markers = affine.double(), markers.double()
    rest = affine[..., 0]
    radius = float((rest - rest.mean(0)).norm(dim=1).mean())
    few = markers[~torch.isnan(markers).any(-1).all(1)]
    few = few[:: max(1, len(few) // _FRAMES)]
    if not len(few):
        return FitCheck(math.nan, radius)
    distance = _distance(affine, few)
    found = FitCheck(distance, radius)
    if slip and not found.refused:
        return _with_slip(affine, few, found)
    if not found.noisy:
        return found
    if int((~torch.isnan(few).any(-1).all(0)).sum()) < 3:
        return _uncorrected(found)
    motion = free_motion(few)
    if motion is not None:
        found, few = replace(found, motion=motion), motion.undo(few)
    if check_mirrored(few.nanmedian(0).values, rest).mirrored:
        flipped = few * few.new_tensor([-1.0, 1.0, 1.0])
        pose = pose_of_take(affine, flipped)
        return replace(found, cause="mirror", corrected=_distance(affine, pose.apply(flipped)))
    pose = pose_of_take(affine, few)
    laid = pose.apply(few)
    near = not _is_elsewhere(pose, few, radius)
    if slip and near and motion is None:
        return _with_slip(affine, few, found)
    found = replace(found, similarity=pose)
    corrected = _distance(affine, laid)
    named = unit_of_scale(float(pose.scale[0])) if corrected <= found.limit else ""
    if not named and (motion is not None or (replace(found, distance=corrected).noisy and near and not slip)):
        moved = _distance(affine, _without_motion(affine, laid))
        if moved < _CORRECTED * (corrected if motion is None else distance):
            return replace(found, cause="slip" if motion is None else "motion", corrected=moved)
    if corrected < _CORRECTED * distance and corrected <= found.limit:
        return replace(found, cause="unit" if named else "alignment", corrected=corrected)
    return _uncorrected(found)


def _uncorrected(found: FitCheck) -> FitCheck:
    """Where no correction helps, it is the sites or the rig; or only noise, if the distance is small."""
    return replace(found, cause="attachment") if found.doubtful else found


def _with_slip(affine: Tensor, markers: Tensor, found: FitCheck) -> FitCheck:
    """The check of markers that a rigid motion a frame may move."""
    # Few markers show a motion badly, and worse if it is not taken out: a slip would seem to be another attachment.
    least = min(MIN_MARKERS, int(_seen(markers).max()))
    return _uncorrected(replace(found, distance=_distance(affine, _without_motion(affine, markers, least))))


def _is_elsewhere(pose: Similarity, markers: Tensor, radius: float) -> bool:
    """Whether a similarity moves markers (T,M,3) farther, or changes their size by more, than a helmet's slip would."""
    mean = markers.nanmedian(0).values
    mean = mean[~torch.isnan(mean).any(-1)]
    translation = float((pose.apply(mean)[0] - mean).mean(0).norm())
    angle = math.acos(min(max((float(pose.rotation[0].diagonal().sum()) - 1) / 2, -1.0), 1.0))
    grown = abs(math.log(float(pose.scale[0])))
    return translation > _MAX_SLIP * radius or angle > _MAX_SLIP_ANGLE or grown > math.log(_UNIT_TOLERANCE)


def unit_of_scale(scale: float, read_as: str | None = None) -> str:
    """The unit, ``m``, ``cm``, ``in``, ``mm`` or ``um``, in which coordinates are that must grow by this factor to
    be millimetres; empty where it is none's, or the one they were read in. Of unknown ones those too small were read
    as millimetres, and those too large are."""
    if read_as is None:
        read_as = "mm" if scale > 1 else next((name for name in UNITS if _near(scale * UNITS[name], 1.0)), "mm")
    size = scale * UNITS[read_as]
    return next((name for name, known in UNITS.items() if name != read_as and _near(size, known)), "")


def _near(size: float, other: float) -> bool:
    return other / _UNIT_TOLERANCE < size < other * _UNIT_TOLERANCE


def _distance(affine: Tensor, markers: Tensor) -> float:
    """Median distance of the seen markers (T,M,3) to their sites, weights solved."""
    weights = solve_weights(affine, markers, _RIDGE)
    on_rig = affine[..., 0] + torch.einsum("mcn,tn->tmc", affine[..., 1:], weights)
    return float((markers - on_rig).norm(dim=-1).nanmedian())


def _seen(markers: Tensor) -> Tensor:
    """How many markers each frame shows, (T,)."""
    return (~torch.isnan(markers).any(-1)).sum(1)


def _without_motion(affine: Tensor, markers: Tensor, least: int = MIN_MARKERS) -> Tensor:
    """Markers (T,M,3) of the frames that show at least so many, without their rigid motion."""
    markers = markers[_seen(markers) >= least]
    return frame_poses(affine, markers, markers.new_ones(()), _RIDGE)[1].apply(markers)
