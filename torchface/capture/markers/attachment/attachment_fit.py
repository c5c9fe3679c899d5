"""The sites of markers on a rig, fitted to a range-of-motion take."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture.markers.attachment.site_iterations import LAST_RIDGE, FitState, SiteSearch, SiteSolver
from torchface.capture.markers.attachment.site_uncertainty import SiteUncertainty
from torchface.capture.markers.frame_poses import MIN_MARKERS, rough_poses, solve_frames
from torchface.capture.markers.given_markers import check_labels
from torchface.capture.markers.helmet_motion import HelmetMotion
from torchface.capture.markers.rest_pose import check_not_collinear, check_not_mirrored, inlier_markers, pose_of_points
from torchface.capture.markers.rig_fit_check import DOUBTFUL_SHARE
from torchface.capture.markers.surface_motion import SurfaceMotion, with_one
from torchface.errors import AlignmentError, ValueRangeError
from torchface.escaped_text import listed
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.number_checks import checked_type
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig
from torchface.take import Take

_LAST_ITERATIONS, _TOLERANCE = 6, 1e-3
_COARSE_FRAMES, _CAREFUL_FRAMES, _JOINT_FRAMES = 240, 60, 120
_MIN_MOTION = 0.3
_UNKNOWN_ERROR = 1.0  # millimetres, of a marker before any iteration


@dataclass(frozen=True, eq=False)
class AttachmentFit:
    """The result of :func:`fit_attachment`.

    Args:
        attachment: the sites, labels kept; ``residual`` is their offset at rest, the stand-off included.
        alignment: the take's similarity, marker space to rig space, of a helmet that does not slip.
        errors: root mean square distance of each marker to its site's path after each iteration, (R,M), millimetres.
        weights: of the take, (T,N); 0 in frames that show no marker (or too few to solve for a slip).
        standoff: how far markers stand off the skin, millimetres; 0 where it was not asked for.
        off_skin: distance of each marker from its site, stand-off considered, averaged over the take, (M,), mm.
        uncertainty: which sites and shapes the take leaves uncertain.
        motion: the helmet's against the head, where it slips: what :attr:`alignment` gives is moved by it.
    """

    attachment: Attachment
    alignment: Similarity
    errors: Tensor
    weights: Tensor
    standoff: float
    off_skin: Tensor
    uncertainty: SiteUncertainty
    motion: HelmetMotion | None = None


def fit_attachment(
    rig: BlendshapeRig,
    rom: Take,
    initial: Attachment,
    standoff: bool = False,
    progress: Progress | None = None,
    insist: bool = False,
    scale: bool = True,
) -> AttachmentFit:
    r"""The marker sites that explain a range-of-motion take best.

    .. math:: \min_{s,R,t,\,w,\,x} \sum_{t,m} \lVert s R y_{tm} + t - p(x_m, w_t) - h\, n(x_m, w_t) \rVert^2

    over the take's similarity, the weights of every frame in [0,1], and every marker's point x on the surface. Solved
    by alternation at first: weights of all frames, the similarity (with the stand-off h), then for each marker the best
    point of the nearest triangles over the whole take. Then by Newton steps of sites, similarity and weights together,
    which converge where alternation hardly moves; markers that do not fit are left out of the weights there and may
    move to farther triangles. Both use frames spread over the take; last come alternating iterations on all frames.

    The initial guess is a prior with a standard deviation of 4 mm, so that sites which the take does not determine stay
    near it. A slipping helmet is found by what a rigid motion a frame would explain; its motion is then solved too.

    Args:
        rig: the performer's, N shapes.
        rom: markers (T,M,3) of a range of motion, in any space and scale; NaN for not seen. No frame need be neutral.
        initial: roughly where the markers sit; markers match by label.
        standoff: estimate one distance h of all marker centres from the skin; otherwise it is 0.
        progress: called with each step and how far it is.
        insist: also return sites that the take leaves mostly uncertain, or that do not explain the markers.
        scale: estimate the take's scale; otherwise it is 1, as it is for the performer's own rig in true millimetres.

    Returns:
        An ``AttachmentFit``, markers in the order of ``initial``.

    Raises:
        NameMismatchError: a marker is not in ``initial``.
        ValueRangeError: a marker is seen in no frame, markers do not move, or the take leaves most sites or shapes
            uncertain, unless ``insist``.
        AlignmentError: the markers lie on a line, or unless ``insist`` they are mirrored or the rig does not explain
            them; the message says how far they stay and what is the likely cause.
        TopologyError: ``initial`` belongs to another mesh.

    Source: thesis 4.1.2, algorithm 4, run to convergence; bundle adjustment for the joint steps (Triggs et al. 2000).

    Example:
        >>> from torchface import Track
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False).select(["jawOpen", "mouthPucker", "mouthSmileLeft", "mouthSmileRight"])
        >>> sites = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks[31:])
        >>> weights = torch.rand(20, len(rig.names), generator=torch.Generator().manual_seed(0))
        >>> seen = sites.on(rig.neutral.faces, rig(weights.to(rig.vertices)))
        >>> fit = fit_attachment(rig, Take(60.0, markers=Track(sites.labels, seen)), sites, insist=True)
        >>> bool(fit.off_skin.mean() < 0.5)  # millimetres
        True
    """
    progress = progress or silent
    checked_type("rig", rig, BlendshapeRig)
    checked_type("rom", rom, Take)
    checked_type("initial", initial, Attachment).check(rig.neutral)
    rig = rig.linear("fit_attachment")
    paths = marker_paths(rom, initial)
    motion = SurfaceMotion.of(rig, normals=standoff)
    initial_points = motion.at(motion.points, initial)[..., 0]
    solver = SiteSolver(motion, SiteSearch(motion, initial), initial_points, standoff, scale)
    if not insist:
        check_not_mirrored(paths, initial_points, str(rom.extras.get("source", "take")), rom.extras.get("flipped"))
    middle = paths.nanmedian(0).values
    pose = pose_of_points(middle, initial_points, scale)
    _check_motion(pose.apply(paths))
    off = (pose.apply(middle[None])[0] - initial_points).norm(dim=1)
    shown = paths[~torch.isnan(paths).any(-1).all(1)]
    few = _spread(shown, _COARSE_FRAMES)
    errors: list[Tensor] = []
    # Markers on the helmet would bend the first weights, and with them the sites of the others, for good.
    first = FitState(replace(initial, residual=None), pose, 0.0, None, off.where(~inlier_markers(off), _UNKNOWN_ERROR))
    state = solver.alternate(few, first, errors, progress)
    if solver.helmet_slips(few, state):
        shown = shown[(~torch.isnan(shown).any(-1)).sum(1) >= MIN_MARKERS]
        few = _spread(shown, _COARSE_FRAMES)
        by_frame = replace(first, pose=rough_poses(few, initial_points, pose.scale[0]))
        state = solver.alternate(few, by_frame, errors, progress)
    progress("refining sites and weights together")
    for count, careful in ((_CAREFUL_FRAMES, True), (_JOINT_FRAMES, False)):
        some = _spread(shown, count)
        state = solver.solve_jointly(some, solver.on_frames(some, state), errors, careful)
    uncertainty = solver.uncertainty(some, state, len(paths) / rom.fps, rig.names)
    state = solver.on_frames(shown, state)
    for number in range(_LAST_ITERATIONS):
        state = solver.alternation_step(shown, state, LAST_RIDGE)
        assert state.error is not None
        converged = float((state.error - errors[-1]).abs().max()) < _TOLERANCE
        errors.append(state.error)
        progress("refining sites over the whole take", number + 1)
        if converged and number:
            break
    found = _result(solver, paths, state, errors, rig.neutral.fingerprint(), uncertainty)
    if not insist:
        check_attachment(found, rig)
    return found


def check_attachment(fit: AttachmentFit, rig: BlendshapeRig) -> None:
    """Raises where a fit does not explain its take.

    Raises:
        AlignmentError: the rig does not explain the markers, or not some of them.
        ValueRangeError: the take leaves most sites or shapes uncertain.
    """
    sites = fit.attachment
    radius = mean_radius(sites.on(rig.neutral.faces, rig.vertices))
    check_sites(sites.labels or (), fit.errors[-1], fit.off_skin, radius, fit.uncertainty)


def marker_paths(take: Take, attachment: Attachment) -> Tensor:
    """A take's markers in the order of an attachment, (T,M,3), float64."""
    track = take.markers
    labels = tuple(attachment.labels or ())
    check_labels(() if track is None else track.names, labels)
    assert track is not None
    row = {name: i for i, name in enumerate(track.names)}
    paths = torch.full((len(track), len(labels), 3), torch.nan, dtype=torch.float64)
    known = [i for i, label in enumerate(labels) if label in row]
    paths[:, known] = track.values[:, [row[labels[i]] for i in known]].double()
    if torch.isinf(paths).any():
        raise ValueRangeError("markers: found infinite coordinates, expected millimetres, or NaN for not seen")
    paths[torch.isnan(paths).any(-1)] = torch.nan
    unseen = torch.isnan(paths[..., 0]).all(0).nonzero()[:, 0].tolist()
    if unseen:
        names = ", ".join(labels[i] for i in unseen[:5]) + (", ..." if len(unseen) > 5 else "")
        raise ValueRangeError(
            f"markers: {len(unseen)} of {len(labels)} are seen in no frame ({names}), expected each at least once; "
            "leave them out of the attachment (Attachment.select)"
        )
    check_not_collinear(paths.nanmedian(0).values)
    return paths


def _result(
    solver: SiteSolver,
    paths: Tensor,
    state: FitState,
    errors: list[Tensor],
    fingerprint: str,
    uncertainty: SiteUncertainty,
) -> AttachmentFit:
    """The fit's result; the offset at rest is the mean residual over all frames."""
    affine = solver.at(state)
    rows = state.inliers()
    slips = len(state.pose.scale) > 1
    shown = (~torch.isnan(paths).any(-1)).sum(1) >= (MIN_MARKERS if slips else 1)
    solved, pose = solve_frames(affine[rows], paths[shown][:, rows], state.pose, LAST_RIDGE, state.weights)
    weights = affine.new_zeros(len(paths), affine.shape[-1] - 1)
    weights[shown] = solved
    moved = pose.apply(paths[shown])
    offset = (moved - torch.einsum("mcn,tn->tmc", affine, with_one(solved))).nanmean(0).nan_to_num(0.0)
    at_rest = solver.motion.at(solver.motion.points[..., :1], state.sites)[..., 0]
    sites = Attachment(
        state.sites.triangles,
        state.sites.barycentric.float(),
        state.sites.labels,
        (affine[..., 0] - at_rest + offset).float(),
        fingerprint,
        at_rest.float(),
    )
    helmet = None
    if slips:
        # The scale is known; fitting it would shrink a rotating take.
        scale = pose.scale[:1]
        steady = similarity_transform(scale * paths[shown].reshape(1, -1, 3), moved.reshape(1, -1, 3), scale=False)
        steady = replace(steady, scale=scale)
        helmet, pose = _helmet_motion(steady, pose, shown, affine[..., 0].mean(0)), steady
    off_skin = offset.norm(dim=1)
    return AttachmentFit(sites, pose, torch.stack(errors), weights, state.height, off_skin, uncertainty, helmet)


def _spread(paths: Tensor, count: int) -> Tensor:
    return paths[:: max(1, len(paths) // count)]


def _helmet_motion(steady: Similarity, pose: Similarity, shown: Tensor, pivot: Tensor) -> HelmetMotion:
    """The difference between one pose for all, (1,), and one a frame, (T,): points were seen at R (p - c) + c + t."""
    rotation = torch.eye(3, dtype=pivot.dtype).repeat(len(shown), 1, 1)
    translation = pivot.new_zeros(len(shown), 3)
    rotation[shown] = steady.rotation @ pose.rotation.transpose(1, 2)
    in_take = pose.inverse().apply(pivot[None].expand(int(shown.sum()), 1, 3))
    translation[shown] = (steady.apply(in_take[:, 0])[0]) - pivot
    return HelmetMotion(rotation, translation, pivot)


def _check_motion(moved: Tensor) -> None:
    """Raises where most markers do not move: then their sites are not determined."""
    motion = (moved - moved.nanmean(0)).square().sum(-1).nanmean(0).sqrt()
    typical = float(motion.median())
    if not typical >= _MIN_MOTION:
        raise ValueRangeError(
            f"range of motion: half of the markers move less than {typical:.2f} mm (root mean square), expected at "
            f"least {_MIN_MOTION} mm: play every expression strongly"
        )


# Median over the markers. With a head's own rig it is 0.02 to 0.06 mm; with a rig whose neutral is 0.5 or 1 mm and
# whose shapes are a fifth wrong 0.09 or 0.16; with markers 2 mm off the skin 0.13, since the scale takes most of that
# up; with the rig of a similar head 0.3 to 0.4, of any other 0.7 to 0.9.
MAX_OFF_SKIN = 0.3


def check_sites(
    labels: Sequence[str], error: Tensor, off_skin: Tensor, radius: float, uncertainty: SiteUncertainty
) -> None:
    """Raises where sites do not explain their markers, or where the take leaves most of them uncertain.

    ``fit_check.check_fit`` judges markers on sites that are given; here the sites could move to wherever they fit best,
    and unit, pose and slip are solved for, so what is left has other causes and smaller limits.

    Args:
        error: root mean square distance of each marker to its site, (M,), millimetres.
        off_skin: distance of each marker from its site that lasts over the take, (M,), millimetres.
        radius: of the sites at rest, mean distance from their centre, millimetres.
    """
    typical, offset, limit = float(error.median()), float(off_skin.median()), DOUBTFUL_SHARE * radius
    if not typical <= limit:
        raise AlignmentError(
            f"markers: wherever they sit on the rig, they stay {typical:.2g} mm from their sites (median), expected at "
            f"most {limit:.2g} mm: labels are mixed up, or it is the rig of another head"
        )
    if offset > MAX_OFF_SKIN:
        raise AlignmentError(
            f"markers: they stay {offset:.2g} mm off the rig's skin all the time (median), expected at most "
            f"{MAX_OFF_SKIN} mm: it is the rig of another head, or a rig that is not this exact"
        )
    far = (~inlier_markers(error)).nonzero()[:, 0]
    if len(far):
        worst = far[error[far].argsort(descending=True)].tolist()
        named = listed([f"{labels[i]} ({float(error[i]):.0f} mm)" for i in worst])
        raise AlignmentError(
            f"markers: {named} stay far from the skin while most stay within {typical:.2g} mm: they sit on the "
            "helmet or the body, fell off, or carry another marker's label; correct their label, or leave them out by "
            "a row 'label,' for each in a table (--labels map.csv)"
        )
    if uncertainty.mostly_uncertain:
        sites, shapes = uncertainty.markers, uncertainty.shapes
        raise ValueRangeError(
            f"range of motion: leaves {len(sites)} of {len(labels)} sites uncertain by more than a millimetre and "
            f"{len(shapes)} of {len(uncertainty.names) - len(uncertainty.unseen)} shapes that the markers see "
            f"({listed(shapes)}), expected at most half: play every expression strongly, each by itself"
        )


def mean_radius(points: Tensor) -> float:
    """Mean distance of points (M,3) from their centre."""
    return float(torch.linalg.vector_norm(points - points.mean(0), dim=1).mean())
