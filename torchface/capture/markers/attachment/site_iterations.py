"""The rounds in which marker sites, weights and pose come to explain a take: in turns, and together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture.markers.attachment.attachment_check import tells_weights
from torchface.capture.markers.attachment.best_sites import PathMoments, best_sites
from torchface.capture.markers.attachment.frame_poses import (
    LEAST_SEEN,
    better_pose,
    frame_poses,
    scaled,
    solve_frames,
    without_motion,
)
from torchface.capture.markers.attachment.site_curvature import ARM, TakeCurvature, pose_columns
from torchface.capture.markers.attachment.site_search import SiteSearch
from torchface.capture.markers.attachment.site_uncertainty import SITE_PRIOR, SiteUncertainty, site_uncertainty
from torchface.capture.markers.rest_pose import nudged
from torchface.capture.markers.surface_motion import SurfaceMotion, with_one
from torchface.geometry.similarity import Similarity

# A high ridge at first: while sites are wrong by millimetres the weights must not explain them away. It falls evenly,
# by a factor a round, to where it only keeps the problem definite (mm² a marker).
_FIRST_RIDGE, LAST_RIDGE = 3.0, 0.01
_COARSE_ROUNDS = 50
_JOINT_ROUNDS, _JOINTLY_SETTLED = 6, 5e-3
_LARGEST_SHIFT, _LARGEST_CHANGE = 3.0, 0.3
# A marker that is so many times farther from its site than usual tells no weights while the others settle.
_DOUBTFUL = 1.3
# What is left with a motion a frame, beside what is left without, where the helmet slips.
_SLIP_SHARE, _MOTION_ROUNDS = 0.85, 6


@dataclass(frozen=True, eq=False)
class FitState:
    """Where the fit stands: a pose for all frames or one a frame, and how far each marker was from its site."""

    sites: Attachment
    pose: Similarity
    height: float
    weights: Tensor | None
    error: Tensor | None = None

    def trusted(self, careful: bool = False) -> Tensor:
        """Rows of the markers that tell weights and pose: none far off, and if ``careful`` none that is doubtful."""
        if self.error is None:
            return torch.arange(len(self.sites.triangles))
        told = self.error <= _DOUBTFUL * self.error.median() if careful else tells_weights(self.error)
        return told.nonzero()[:, 0]


@dataclass(frozen=True, eq=False)
class SiteRounds:
    """What stays the same over all rounds.

    Args:
        motion: how the rig's surface moves.
        search: where triangles are looked for.
        start: the first guess at rest, (M,3), millimetres.
        standoff: estimate the markers' distance from the skin.
    """

    motion: SurfaceMotion
    search: SiteSearch
    start: Tensor
    standoff: bool

    def at(self, state: FitState) -> Tensor:
        """Affine maps of the sites (M,3,N+1)."""
        return self.motion.at(self.motion.lifted(state.height), state.sites)

    def in_turns(self, few: Tensor, state: FitState, errors: list[Tensor], say: Callable[[float], None]) -> FitState:
        """Rounds in turns, with a falling ridge."""
        for number in range(_COARSE_ROUNDS):
            ridge = _FIRST_RIDGE * (LAST_RIDGE / _FIRST_RIDGE) ** (number / (_COARSE_ROUNDS - 1))
            state = self.round(few, state, ridge)
            assert state.error is not None
            errors.append(state.error)
            say((number + 1) / _COARSE_ROUNDS)
        return state

    def round(self, paths: Tensor, state: FitState, ridge: float) -> FitState:
        """Weights, then pose, then sites, then the error of each marker."""
        rows = state.trusted()
        here = self.at(state)
        weights, pose = solve_frames(here[rows], paths[:, rows], state.pose, ridge, state.weights)
        extended = with_one(weights)
        on_rig = torch.einsum("mcn,tn->tmc", here, extended)
        outward = None
        if self.standoff:
            assert self.motion.normals is not None
            outward = torch.einsum("mcn,tn->tmc", self.motion.at(self.motion.normals, state.sites), extended)[:, rows]
        pose, rise = better_pose(paths[:, rows], pose, on_rig[:, rows], outward)
        state = replace(state, pose=pose, height=state.height + rise, weights=weights)
        return self._settled(paths, state, on_rig, here[..., 0], wide=False)

    def together(self, paths: Tensor, state: FitState, errors: list[Tensor], careful: bool) -> FitState:
        """Joint rounds until errors stay."""
        for number in range(_JOINT_ROUNDS):
            before = state
            state = self.joint_round(paths, state, careful)
            assert state.error is not None
            assert before.error is not None
            errors.append(state.error)
            if number and float((state.error - before.error).abs().max()) < _JOINTLY_SETTLED:
                break
        return state

    def joint_round(self, paths: Tensor, state: FitState, careful: bool) -> FitState:
        """One Newton step of sites, pose and weights together, then the best sites for the weights it led to."""
        rows = state.trusted(careful)
        here = self.at(state)
        weights, pose = solve_frames(here[rows], paths[:, rows], state.pose, LAST_RIDGE, state.weights)
        state = replace(state, pose=pose, weights=weights)
        on_rig = torch.einsum("mcn,tn->tmc", here[rows], with_one(weights))
        tangents = self._tangents(state)[rows]
        columns = pose_columns(on_rig, pose)
        moved = pose.apply(paths[:, rows])
        slips = len(pose.scale) > 1
        curvature = TakeCurvature.of(here[rows], tangents, moved, weights, columns, LAST_RIDGE, slips)
        off = torch.einsum("mkc,mc->mk", tangents[..., 0], self.start[rows] - here[rows, :, 0])
        stiffness = here.new_zeros(len(curvature.gradient))
        stiffness[: 2 * len(rows)] = self._trust(state)
        pull = torch.zeros_like(stiffness)
        pull[: 2 * len(rows)] = self._trust(state) * off.flatten()
        shift, change = curvature.step(stiffness, pull)
        shapes = weights.shape[1]
        length = torch.stack(
            [shift[: 2 * len(rows)].abs().max() / _LARGEST_SHIFT, change[:, :shapes].abs().max() / _LARGEST_CHANGE]
        )
        part = 1 / length.max().clamp(min=1)
        shift, change = part * shift, part * change
        turned = shift[2 * len(rows) :]
        if slips:
            pose = without_motion(pose, change[:, shapes:], here[rows, :, 0].mean(0))
            pose = scaled(pose, 1 + turned[0] / ARM, on_rig.mean(1))
        else:
            pose = nudged(pose, on_rig.mean((0, 1)), turned[3:6] / ARM, turned[:3], 1 + turned[6] / ARM)
        rest = here[..., 0].clone()
        rest[rows] += torch.einsum("mkc,mk->mc", tangents[..., 0], shift[: 2 * len(rows)].unflatten(0, (-1, 2)))
        state = replace(state, pose=pose, weights=(weights + change[:, :shapes]).clamp(0, 1))
        assert state.weights is not None
        on_rig = torch.einsum("mcn,tn->tmc", here, with_one(state.weights))
        return self._settled(paths, state, on_rig, rest, wide=careful)

    def slips(self, paths: Tensor, state: FitState) -> bool:
        """Whether a rigid motion a frame explains much of what is left."""
        rows = state.trusted()
        shown = (~torch.isnan(paths[:, rows]).any(-1)).sum(1) >= LEAST_SEEN
        if len(rows) < LEAST_SEEN or not bool(shown.any()) or state.weights is None:
            return False
        paths, weights, here = paths[shown][:, rows], state.weights[shown], self.at(state)[rows]
        pose = Similarity(*(part.expand(len(paths), *part.shape[1:]) for part in _parts(state.pose)))
        left = []
        for by_frame in (state.pose, pose):
            solved, there = solve_frames(here, paths, by_frame, LAST_RIDGE, weights)
            apart = there.apply(paths) - torch.einsum("mcn,tn->tmc", here, with_one(solved))
            left.append(float(apart.square().nanmean().sqrt()))
        return left[1] < _SLIP_SHARE * left[0]

    def uncertainty(self, paths: Tensor, state: FitState, seconds: float, names: tuple[str, ...]) -> SiteUncertainty:
        """Of sites and shapes, from the curvature here."""
        here = self.at(state)
        assert state.weights is not None
        on_rig = torch.einsum("mcn,tn->tmc", here, with_one(state.weights))
        return site_uncertainty(
            here,
            self._tangents(state),
            state.pose.apply(paths),
            state.weights,
            pose_columns(on_rig, state.pose),
            seconds,
            names,
            state.sites.labels or (),
            len(state.pose.scale) > 1,
        )

    def resumed(self, paths: Tensor, state: FitState) -> FitState:
        """The state for other frames: weights to be solved anew, and a pose a frame where the helmet slips."""
        if len(state.pose.scale) == 1:
            return replace(state, weights=None)
        rows = state.trusted()
        here = self.at(state)[rows]
        pose = frame_poses(paths, self.at(state)[..., 0].expand_as(paths), state.pose.scale[0])
        weights: Tensor | None = None
        for _ in range(_MOTION_ROUNDS):
            weights, pose = solve_frames(here, paths[:, rows], pose, LAST_RIDGE, weights)
        return replace(state, pose=pose, weights=weights)

    def _settled(self, paths: Tensor, state: FitState, on_rig: Tensor, rest: Tensor, wide: bool) -> FitState:
        """The best sites near where they are at rest (M,3), and the error of each marker there."""
        assert state.weights is not None
        extended = with_one(state.weights)
        moved = state.pose.apply(paths)
        moments = PathMoments.of(moved, extended, on_rig, self.start, self._trust(state))
        lifted = self.motion.lifted(state.height)
        near = self.search.near(rest)
        if wide:
            near = torch.cat([near, self.search.alike(lifted, rest, moments)], dim=1)
        found = best_sites(lifted, self.motion.faces, near, moments)
        state = replace(state, sites=Attachment(found.triangles, found.barycentric, state.sites.labels))
        apart = moved - torch.einsum("mcn,tn->tmc", self.at(state), extended)
        return replace(state, error=apart.square().sum(-1).nanmean(0).sqrt().nan_to_num(0.0))

    def _trust(self, state: FitState) -> float:
        """How much the first guess counts beside one sample of a marker."""
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
