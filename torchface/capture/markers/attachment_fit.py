"""Where markers really sit on a rig: found from a range-of-motion take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture.markers.rest_pose import check_spread, pose_step, solve_weights
from torchface.capture.markers.sites import PathMoments, best_sites
from torchface.capture.markers.solve import check_labels
from torchface.capture.markers.surface_motion import SurfaceMotion, with_one
from torchface.errors import ValueRangeError
from torchface.geometry.alignment import Similarity, similarity_transform
from torchface.rig import BlendshapeRig
from torchface.take import Take

# A high ridge at first: while sites are wrong by millimetres the weights must not explain them away. It falls evenly,
# by a factor a round, to where it only keeps the problem definite (mm² a marker).
_FIRST_RIDGE, _LAST_RIDGE = 3.0, 0.01
_COARSE_ROUNDS, _COARSE_FRAMES = 100, 240
_WHOLE_ROUNDS, _SETTLED = 10, 1e-3
_CANDIDATES = 24
_LEAST_MOTION = 0.3


@dataclass(frozen=True, eq=False)
class AttachmentFit:
    """What a range-of-motion take told.

    Args:
        attachment: the sites, labels kept; ``residual`` is what was left at rest, the stand-off included.
        alignment: the take's similarity, marker space to rig space.
        errors: root mean square distance of each marker to its site's path after each round, (R,M), millimetres.
        weights: what the rig did in the take, (T,N).
        standoff: how far markers stand off the skin, millimetres; 0 where it was not asked for.
    """

    attachment: Attachment
    alignment: Similarity
    errors: Tensor
    weights: Tensor
    standoff: float


@dataclass(frozen=True, eq=False)
class _State:
    """Where the alternation stands."""

    sites: Attachment
    pose: Similarity
    height: float
    weights: Tensor | None


def fit_attachment(
    rig: BlendshapeRig,
    rom: Take,
    initial: Attachment,
    standoff: bool = False,
    progress: Callable[[float], None] | None = None,
) -> AttachmentFit:
    r"""The marker sites that explain a range-of-motion take best.

    .. math:: \min_{s,R,t,\,w,\,x} \sum_{t,m} \lVert s R y_{tm} + t - p(x_m, w_t) - h\, n(x_m, w_t) \rVert^2

    over the take's similarity, the weights of every frame in [0,1], and every marker's point x on the surface. Solved
    in turns: weights of all frames, the similarity (with the stand-off h), then for each marker the best point of the
    nearest triangles over the whole take. Frames spread over the take serve until the ridge on the weights has fallen;
    then all frames, until no marker's error changes by more than a thousandth of a millimetre.

    Args:
        rig: the performer's, N shapes.
        rom: markers (T,M,3) of a range of motion, in any space and scale; NaN for not seen. No frame need be neutral.
        initial: roughly where the markers sit; markers match by label.
        standoff: estimate one distance h of all marker centres from the skin; otherwise it is 0.
        progress: told the share that is done.

    Returns:
        ``AttachmentFit(attachment, alignment, errors, weights, standoff)``, markers in the order of ``initial``.

    Raises:
        NameMismatchError: a marker is not in ``initial``.
        ValueRangeError: a marker is seen in no frame, or markers do not move.
        AlignmentError: the markers lie on a line.
        TopologyError: ``initial`` belongs to another mesh.

    Source: thesis 4.1.2, algorithm 4, run to convergence.
    """
    say = progress or (lambda share: None)
    initial.check(rig.neutral)
    paths = marker_paths(rom, initial)
    motion = SurfaceMotion.of(rig, normals=standoff)
    search = _CandidateSearch(motion, initial)
    rest = motion.at(motion.points, initial)[..., 0]
    pose = similarity_transform(paths.nanmean(0)[None], rest[None])
    _check_motion(pose.apply(paths))
    state = _State(replace(initial, residual=None), pose, 0.0, None)
    few = paths[:: max(1, len(paths) // _COARSE_FRAMES)]
    few = few[~torch.isnan(few).any(-1).all(1)]
    errors: list[Tensor] = []
    for number in range(_COARSE_ROUNDS):
        ridge = _FIRST_RIDGE * (_LAST_RIDGE / _FIRST_RIDGE) ** (number / (_COARSE_ROUNDS - 1))
        state, error = _round(motion, search, few, state, ridge, standoff)
        errors.append(error)
        say((number + 1) / (_COARSE_ROUNDS + _WHOLE_ROUNDS))
    state = replace(state, weights=None)
    shown = paths[~torch.isnan(paths).any(-1).all(1)]
    for number in range(_WHOLE_ROUNDS):
        state, error = _round(motion, search, shown, state, _LAST_RIDGE, standoff)
        settled = float((error - errors[-1]).abs().max()) < _SETTLED
        errors.append(error)
        say((_COARSE_ROUNDS + number + 1) / (_COARSE_ROUNDS + _WHOLE_ROUNDS))
        if settled and number:
            break
    say(1.0)
    return _result(motion, paths, state, errors, rig.neutral.fingerprint())


def marker_paths(take: Take, attachment: Attachment) -> Tensor:
    """A take's markers in the order of an attachment, (T,M,3), float64.

    Raises:
        NameMismatchError: the take has no markers, or one that the attachment does not know.
        ValueRangeError: a marker of the attachment is seen in no frame, or a coordinate is infinite.
        AlignmentError: the markers lie on a line, so no pose can be told.
    """
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
    check_spread(paths.nanmean(0))
    return paths


class _CandidateSearch:
    """The triangles of the skin nearest to a point at rest."""

    def __init__(self, motion: SurfaceMotion, initial: Attachment) -> None:
        # Sites on another part, such as teeth, keep to triangles like those that they start from.
        skin = motion.skin if bool(motion.skin[initial.triangles].all()) else torch.ones_like(motion.skin)
        self.rows = skin.nonzero()[:, 0]
        self._tree = cKDTree(motion.points[motion.faces[self.rows], :, 0].mean(1).numpy())

    def near(self, points: Tensor) -> Tensor:
        """Rows of the faces, (M,Q)."""
        count = min(_CANDIDATES, len(self.rows))
        found = torch.from_numpy(self._tree.query(points.numpy(), k=count)[1])
        return self.rows[found.reshape(len(points), count)]


def _round(
    motion: SurfaceMotion, search: _CandidateSearch, paths: Tensor, state: _State, ridge: float, standoff: bool
) -> tuple[_State, Tensor]:
    """Weights, then pose, then sites; and the error of each marker (M,)."""
    here = motion.at(motion.lifted(state.height), state.sites)
    moved = state.pose.apply(paths)
    weights = solve_weights(here, moved, ridge, state.weights)
    extended = with_one(weights)
    on_rig = torch.einsum("mcn,tn->tmc", here, extended)
    outward = None
    if standoff:
        assert motion.normals is not None
        outward = torch.einsum("mcn,tn->tmc", motion.at(motion.normals, state.sites), extended)
    pose, rise = pose_step(paths, state.pose, on_rig, outward)
    height = state.height + rise
    moments = PathMoments.of(pose.apply(paths), extended, on_rig)
    at_rest = motion.at(motion.points[..., :1], state.sites)[..., 0]
    found = best_sites(motion.lifted(height), motion.faces, search.near(at_rest), moments)
    sites = Attachment(found.triangles, found.barycentric, state.sites.labels)
    return _State(sites, pose, height, weights), found.error


def _result(
    motion: SurfaceMotion, paths: Tensor, state: _State, errors: list[Tensor], fingerprint: str
) -> AttachmentFit:
    """What was left at rest is told over all frames, with the weights of the sites that were found."""
    here = motion.at(motion.lifted(state.height), state.sites)
    moved = state.pose.apply(paths)
    shown = ~torch.isnan(moved).any(-1).all(1)
    weights = moved.new_zeros(len(moved), here.shape[-1] - 1)
    weights[shown] = solve_weights(here, moved[shown], _LAST_RIDGE, state.weights)
    left = (moved - torch.einsum("mcn,tn->tmc", here, with_one(weights))).nanmean(0)
    at_rest = motion.at(motion.points[..., :1], state.sites)[..., 0]
    sites = Attachment(
        state.sites.triangles,
        state.sites.barycentric.float(),
        state.sites.labels,
        (here[..., 0] - at_rest + left).float(),
        fingerprint,
    )
    return AttachmentFit(sites, state.pose, torch.stack(errors), weights, state.height)


def _check_motion(moved: Tensor) -> None:
    """Raises where most markers stand still: then nothing tells where they sit."""
    spread = (moved - moved.nanmean(0)).square().sum(-1).nanmean(0).sqrt()
    typical = float(spread.median())
    if not typical >= _LEAST_MOTION:
        raise ValueRangeError(
            f"range of motion: half of the markers move less than {typical:.2f} mm (root mean square), expected at "
            f"least {_LEAST_MOTION} mm: play every expression strongly"
        )
