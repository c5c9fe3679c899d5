"""The iterations that fit marker sites, weights and pose to a take: alternating, then jointly."""

from dataclasses import dataclass, replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture.markers.attachment.best_sites import PathMoments, best_sites
from torchface.capture.markers.attachment.site_curvature import ARM, SitesOnTake, TakeCurvature, pose_columns
from torchface.capture.markers.attachment.site_uncertainty import SITE_PRIOR, SiteUncertainty, site_uncertainty
from torchface.capture.markers.frame_poses import (
    MIN_MARKERS,
    better_pose,
    frame_poses,
    scaled,
    solve_frames,
    without_motion,
)
from torchface.capture.markers.rest_pose import inlier_markers, transformed_pose
from torchface.capture.markers.surface_motion import SurfaceMotion, with_one
from torchface.geometry.similarity import Similarity
from torchface.progress import Progress

# A high ridge at first: while sites are wrong by millimetres the weights must not explain them away. It falls by a
# constant factor an iteration to where it only keeps the problem definite (mm² a marker).
_FIRST_RIDGE, LAST_RIDGE = 3.0, 0.01
_ALTERNATING_ITERATIONS = 50
_JOINT_ITERATIONS, _JOINT_TOLERANCE = 6, 5e-3
_MAX_SITE_STEP, _MAX_WEIGHT_STEP = 3.0, 0.3
# A marker farther from its site than so many times the median is left out while the others converge.
_OUTLIER_RATIO = 1.3
# Curvature that holds the scale where it is.
_HELD = 1e15
# The helmet slips where a rigid motion a frame leaves less than this part of the residual.
_SLIP_RATIO = 0.85
_CANDIDATES = 24
# Of so many triangles about a site those whose motion is most like the marker's are candidates, too.
_NEIGHBOURHOOD, _SIMILAR = 400, 12


@dataclass(frozen=True, eq=False)
class FitState:
    """The state of the fit: a pose for all frames or one a frame, and the error of each marker."""

    sites: Attachment
    pose: Similarity
    height: float
    weights: Tensor | None
    error: Tensor | None = None

    def inliers(self, careful: bool = False) -> Tensor:
        """Rows of the markers that weights and pose are solved from; ``careful`` takes the stricter limit."""
        if self.error is None:
            return torch.arange(len(self.sites.triangles))
        inlier = self.error <= _OUTLIER_RATIO * self.error.median() if careful else inlier_markers(self.error)
        return inlier.nonzero()[:, 0]


@dataclass(frozen=True, eq=False)
class SiteSolver:
    """Solves for sites, weights and pose; holds what is the same in all iterations."""

    motion: SurfaceMotion
    search: "SiteSearch"  # for candidate triangles
    initial: Tensor  # the initial guess of the sites at rest, (M,3), millimetres
    standoff: bool  # estimate the markers' distance from the skin
    scale: bool = True

    def at(self, state: FitState) -> Tensor:
        """Affine maps of the sites (M,3,N+1)."""
        return self.motion.at(self.motion.lifted(state.height), state.sites)

    def alternate(self, few: Tensor, state: FitState, errors: list[Tensor], progress: Progress) -> FitState:
        """Alternating iterations with a falling ridge."""
        for number in range(_ALTERNATING_ITERATIONS):
            ridge = _FIRST_RIDGE * (LAST_RIDGE / _FIRST_RIDGE) ** (number / (_ALTERNATING_ITERATIONS - 1))
            state = self.alternation_step(few, state, ridge)
            assert state.error is not None
            errors.append(state.error)
            progress("finding the markers' sites", number + 1, _ALTERNATING_ITERATIONS)
        return state

    def alternation_step(self, paths: Tensor, state: FitState, ridge: float) -> FitState:
        """Weights, then pose, then sites, then the error of each marker."""
        rows = state.inliers()
        affine = self.at(state)
        weights, pose = solve_frames(affine[rows], paths[:, rows], state.pose, ridge, state.weights)
        extended = with_one(weights)
        on_rig = torch.einsum("mcn,tn->tmc", affine, extended)
        outward = None
        if self.standoff:
            assert self.motion.normals is not None
            outward = torch.einsum("mcn,tn->tmc", self.motion.at(self.motion.normals, state.sites), extended)[:, rows]
        pose, height_step = better_pose(paths[:, rows], pose, on_rig[:, rows], outward, self.scale)
        state = replace(state, pose=pose, height=state.height + height_step, weights=weights)
        return self._with_best_sites(paths, state, on_rig, affine[..., 0], wide=False)

    def solve_jointly(self, paths: Tensor, state: FitState, errors: list[Tensor], careful: bool) -> FitState:
        """Joint iterations until the errors converge."""
        for number in range(_JOINT_ITERATIONS):
            before = state
            state = self.joint_step(paths, state, careful)
            assert state.error is not None
            assert before.error is not None
            errors.append(state.error)
            if number and float((state.error - before.error).abs().max()) < _JOINT_TOLERANCE:
                break
        return state

    def joint_step(self, paths: Tensor, state: FitState, careful: bool) -> FitState:
        """One Newton step of sites, pose and weights together, then the best sites for its weights."""
        rows = state.inliers(careful)
        affine = self.at(state)
        weights, pose = solve_frames(affine[rows], paths[:, rows], state.pose, LAST_RIDGE, state.weights)
        state = replace(state, pose=pose, weights=weights)
        on_rig = torch.einsum("mcn,tn->tmc", affine[rows], with_one(weights))
        tangents = self._tangents(state)[rows]
        columns = pose_columns(on_rig, pose)
        moved = pose.apply(paths[:, rows])
        slips = len(pose.scale) > 1
        curvature = TakeCurvature.of(SitesOnTake(affine[rows], tangents, moved, weights, columns, slips), LAST_RIDGE)
        offset = torch.einsum("mkc,mc->mk", tangents[..., 0], self.initial[rows] - affine[rows, :, 0])
        precision = affine.new_zeros(len(curvature.gradient))
        precision[: 2 * len(rows)] = self._prior_weight(state)
        if not self.scale:
            precision[-1] = _HELD
        gradient = torch.zeros_like(precision)
        gradient[: 2 * len(rows)] = self._prior_weight(state) * offset.flatten()
        step, change = curvature.step(precision, gradient)
        shapes = weights.shape[1]
        length = torch.stack(
            [step[: 2 * len(rows)].abs().max() / _MAX_SITE_STEP, change[:, :shapes].abs().max() / _MAX_WEIGHT_STEP]
        )
        part = 1 / length.max().clamp(min=1)
        step, change = part * step, part * change
        pose_step = step[2 * len(rows) :]
        if slips:
            pose = without_motion(pose, change[:, shapes:], affine[rows, :, 0].mean(0))
            pose = scaled(pose, 1 + pose_step[0] / ARM, on_rig.mean(1))
        else:
            pose = transformed_pose(
                pose, on_rig.mean((0, 1)), pose_step[3:6] / ARM, pose_step[:3], 1 + pose_step[6] / ARM
            )
        rest = affine[..., 0].clone()
        rest[rows] += torch.einsum("mkc,mk->mc", tangents[..., 0], step[: 2 * len(rows)].unflatten(0, (-1, 2)))
        state = replace(state, pose=pose, weights=(weights + change[:, :shapes]).clamp(0, 1))
        assert state.weights is not None
        on_rig = torch.einsum("mcn,tn->tmc", affine, with_one(state.weights))
        return self._with_best_sites(paths, state, on_rig, rest, wide=careful)

    def helmet_slips(self, paths: Tensor, state: FitState) -> bool:
        """Whether a rigid motion a frame explains much of the residual."""
        rows = state.inliers()
        shown = (~torch.isnan(paths[:, rows]).any(-1)).sum(1) >= MIN_MARKERS
        if len(rows) < MIN_MARKERS or not bool(shown.any()) or state.weights is None:
            return False
        paths, weights, affine = paths[shown][:, rows], state.weights[shown], self.at(state)[rows]
        pose = Similarity(*(part.expand(len(paths), *part.shape[1:]) for part in _parts(state.pose)))
        residuals = []
        for by_frame in (state.pose, pose):
            solved, solved_pose = solve_frames(affine, paths, by_frame, LAST_RIDGE, weights)
            residual = solved_pose.apply(paths) - torch.einsum("mcn,tn->tmc", affine, with_one(solved))
            residuals.append(float(residual.square().nanmean().sqrt()))
        return residuals[1] < _SLIP_RATIO * residuals[0]

    def uncertainty(self, paths: Tensor, state: FitState, seconds: float, names: tuple[str, ...]) -> SiteUncertainty:
        """Of sites and shapes, from the curvature at this state."""
        affine = self.at(state)
        assert state.weights is not None
        on_rig = torch.einsum("mcn,tn->tmc", affine, with_one(state.weights))
        fit = SitesOnTake(
            affine,
            self._tangents(state),
            state.pose.apply(paths),
            state.weights,
            pose_columns(on_rig, state.pose),
            len(state.pose.scale) > 1,
        )
        return site_uncertainty(fit, seconds, names, state.sites.labels or ())

    def on_frames(self, paths: Tensor, state: FitState) -> FitState:
        """The state for other frames: weights to be solved again, and a pose a frame where the helmet slips."""
        if len(state.pose.scale) == 1:
            return replace(state, weights=None)
        rows = state.inliers()
        weights, pose = frame_poses(self.at(state)[rows], paths[:, rows], state.pose.scale[0], LAST_RIDGE)
        return replace(state, pose=pose, weights=weights)

    def _with_best_sites(self, paths: Tensor, state: FitState, on_rig: Tensor, rest: Tensor, wide: bool) -> FitState:
        """The state with the best sites near points at rest (M,3), and the error of each marker there."""
        assert state.weights is not None
        extended = with_one(state.weights)
        moved = state.pose.apply(paths)
        moments = PathMoments.of(moved, extended, on_rig, self.initial, self._prior_weight(state))
        lifted = self.motion.lifted(state.height)
        near = self.search.near(rest)
        if wide:
            near = torch.cat([near, self.search.similar_motion(lifted, rest, moments)], dim=1)
        found = best_sites(lifted, self.motion.faces, near, moments)
        state = replace(state, sites=Attachment(found.triangles, found.barycentric, state.sites.labels))
        residual = moved - torch.einsum("mcn,tn->tmc", self.at(state), extended)
        return replace(state, error=residual.square().sum(-1).nanmean(0).sqrt().nan_to_num(0.0))

    def _prior_weight(self, state: FitState) -> float:
        """Weight of the initial guess against one sample of a marker."""
        typical = 1.0 if state.error is None else float(state.error.median())
        return typical**2 / 3 / SITE_PRIOR**2

    def _tangents(self, state: FitState) -> Tensor:
        """Affine maps of two tangents at each site, unit length at rest, (M,2,3,N+1)."""
        corner = self.motion.lifted(state.height)[self.motion.faces[state.sites.triangles]]
        edges = torch.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], dim=1)
        triangular = torch.linalg.qr(edges[..., 0].transpose(1, 2)).R
        return torch.einsum("mkcn,mkj->mjcn", edges, torch.linalg.inv(triangular))


def _parts(pose: Similarity) -> tuple[Tensor, Tensor, Tensor]:
    return pose.scale, pose.rotation, pose.translation


class SiteSearch:
    """Candidate triangles for sites; all on the skin, if the initial guess is."""

    def __init__(self, motion: SurfaceMotion, initial: Attachment) -> None:
        # Sites on another part, such as teeth, keep to the triangles of their own part.
        skin = motion.skin if bool(motion.skin[initial.triangles].all()) else torch.ones_like(motion.skin)
        self.rows = skin.nonzero()[:, 0]
        self._faces = motion.faces
        self._tree = cKDTree(motion.points[motion.faces[self.rows], :, 0].mean(1).numpy())

    def near(self, points: Tensor, count: int = _CANDIDATES) -> Tensor:
        """Rows of the faces nearest to points (M,3) at rest, (M,Q)."""
        count = min(count, len(self.rows))
        found = torch.from_numpy(self._tree.query(points.numpy(), k=count)[1])
        return self.rows[found.reshape(len(points), count)]

    def similar_motion(self, lifted: Tensor, points: Tensor, moments: PathMoments) -> Tensor:
        """Of the faces round sites (M,3) those, (M,Q), whose middle moves most like the marker, by the maps
        (V,3,N+1)."""
        around = self.near(points, _NEIGHBOURHOOD)
        used, row = around.unique(return_inverse=True)
        middle = (lifted[self._faces[used]].mean(1) @ moments.factor).flatten(1)
        distance = torch.cdist(moments.path.flatten(1), middle).gather(1, row)
        best = distance.topk(min(_SIMILAR, around.shape[1]), dim=1, largest=False).indices
        return around.gather(1, best)
