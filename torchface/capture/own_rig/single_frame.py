"""One frame's steps of Gauss and Newton in NumPy: of so few numbers its calls take a fifth of PyTorch's time.

The energy is that of ``FrameSolver.energy`` for one frame of one camera without learned priors; the tests compare them.
"""

import math
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.capture.own_rig.face_points import JAW, LANDMARKS, FacePoints
from torchface.capture.own_rig.frame_states import FrameTerms
from torchface.capture.own_rig.gauss_newton import SLIDING_STEPS, HeadState
from torchface.capture.own_rig.video_settings import VideoSettings
from torchface.optim.prepared_program import PreparedProgram

Array: TypeAlias = "np.ndarray"

_OWN = np.arange(LANDMARKS)
_NOTHING = 1e-6  # as of ``antagonist_shapes``


@dataclass(frozen=True, eq=False)
class _Points:
    """``FacePoints`` as arrays, without correctives."""

    rest: Array
    basis: Array
    rows: Array
    valid: Array
    side: Array

    @classmethod
    def of(cls, points: FacePoints) -> "_Points":
        return cls(*(getattr(points, part).detach().numpy() for part in cls.__dataclass_fields__))

    def chosen(self, weights: Array, rotation: Array, translation: Array, K: Array) -> Array:
        """Rows (68,); see ``FacePoints.chosen``."""
        if self.rows.shape[1] == 1:
            return _OWN
        moved = self.basis.reshape(-1, len(weights)) @ weights
        image = (self.rest + moved.reshape(-1, 3)) @ (K @ rotation).T + K @ translation
        across = np.array([-rotation[1, 1], rotation[0, 1]])
        if across @ rotation[:2, 0] < 0:
            across = -across
        reach = (image[:, :2] @ across / image[:, 2])[self.rows] * self.side[:, None]
        best = np.where(self.valid, reach, -np.inf).argmax(1)
        best[self.side == 0] = 0
        slid = self.rows[_OWN[:JAW], best]
        return np.concatenate([np.where(best > 0, slid, _OWN[:JAW]), _OWN[JAW:]])


@dataclass(frozen=True, eq=False)
class SingleFrame:
    """One frame's energy and its steps."""

    settings: VideoSettings
    terms: FrameTerms  # of one frame; without views of other cameras
    points: FacePoints  # of the rig; without correctives
    intrinsics: Tensor  # (3,3) float64
    # lower, upper, l1_penalty, ridge: of a step, (N+6,) float64
    lower: Tensor
    upper: Tensor
    l1_penalty: Tensor
    ridge: Tensor
    signed: Tensor  # see `signed_quantities`, (K,N) float64

    def solve(self, start: HeadState, exactness: float) -> tuple[HeadState, Tensor]:
        """Weights and pose from a start, with which point each landmark is; see ``FrameSolver.solve``."""
        points, K = _Points.of(self.points), self.intrinsics.numpy()
        w, R, t = (getattr(start, name)[0].numpy() for name in ("weights", "rotation", "translation"))
        signed, rows = self.signed.numpy(), points.chosen(w, R, t, K)
        for iteration in range(self.settings.steps):
            if 0 < iteration < SLIDING_STEPS:
                rows = points.chosen(w, R, t, K)
            H, f = self.energy(w, R, t, rows)
            before = w
            free = np.ones(len(f))
            if iteration > 0:
                free[: len(w)] = ~_weaker(w, signed)
            w, R, t = self._box_step(H, f, w, R, t, free, exactness)
            if iteration > 0:
                w = np.where(_weaker(w, signed), 0.0, w)
                if np.abs(w - before).max() < self.settings.tolerance:
                    break
        found = (torch.from_numpy(x)[None] for x in (w, R, t))
        return HeadState(*found), torch.from_numpy(rows)[None]

    def energy(self, w: Array, R: Array, t: Array, rows: Array) -> tuple[Array, Array]:
        """H (N+6,N+6) and f (N+6,) of a step from a state."""
        terms, mean, count = self.terms, self.terms.expected.mean, len(w)
        residual, J = self._linearised(w, R, t, rows)
        information, ridge = terms.expected.information[0].detach().numpy(), self.ridge.numpy()
        turn = _turn(mean.rotation[0].detach().numpy(), R)
        off = np.concatenate([w - mean.weights[0].detach().numpy(), turn, t - mean.translation[0].detach().numpy()])
        H = J.T @ J + information
        f = residual @ J + information @ off + self.l1_penalty.numpy() + ridge * np.append(w, np.zeros(6))
        H[np.diag_indices(count + 6)] += ridge
        if terms.read is not None:
            read = terms.read.H.detach().numpy().reshape(count, count)
            H[:count, :count] += read
            f[:count] += terms.read.f[0].detach().numpy() + read @ w
        return H, f

    def _linearised(self, w: Array, R: Array, t: Array, rows: Array) -> tuple[Array, Array]:
        """Residuals (136,) and their derivatives (136,N+6); see ``linearise``."""
        K, terms = self.intrinsics.numpy(), self.terms
        basis = self.points.basis.detach().numpy()[rows]
        turned = (self.points.rest.detach().numpy()[rows] + basis @ w) @ R.T
        image = (turned + t) @ K.T
        depth = image[:, 2:]
        pixels = image[:, :2] / depth
        lines = np.empty((LANDMARKS, 2, 4))
        lines[:, :, 0] = pixels - terms.landmarks[0].detach().numpy()
        lines[:, :, 1:] = (K[:2] - pixels[..., None] * K[2]) / depth[..., None]
        lines *= terms.precision[0].detach().numpy()[:, None, None]
        along = self.settings.contour_slide
        if along < 1:
            beyond = np.concatenate([pixels[:1], pixels[:JAW], pixels[JAW - 1 : JAW]])
            tangent = beyond[2:] - beyond[:-2]
            tangent /= np.maximum(np.sqrt((tangent * tangent).sum(1, keepdims=True)), 1e-12)
            lines[:JAW] -= (1 - along) * tangent[:, :, None] * (tangent[:, None] @ lines[:JAW])
        by_place = lines[:, :, 1:]
        J = np.empty((LANDMARKS, 2, len(w) + 6))
        J[:, :, :-6] = (by_place @ R) @ basis
        (x, y, z), (a, b, c) = turned.T[..., None], by_place.transpose(2, 0, 1)
        J[:, :, -6], J[:, :, -5], J[:, :, -4] = y * c - z * b, z * a - x * c, x * b - y * a
        J[:, :, -3:] = by_place
        return lines[:, :, 0].ravel(), J.reshape(2 * LANDMARKS, -1)

    def _box_step(
        self, H: Array, f: Array, w: Array, R: Array, t: Array, free: Array, exactness: float
    ) -> tuple[Array, Array, Array]:
        """The state at the least in the box; see ``box_step``."""
        begin = np.append(w, np.zeros(6))
        f = (f - H @ begin) * free
        diagonal = H.diagonal().copy()
        H = H * free[:, None] * free
        H = 0.5 * (H + H.T)
        H[np.diag_indices(len(f))] = diagonal
        program = PreparedProgram(torch.from_numpy(H)[None], self.lower, self.upper)
        least = program.solve(torch.from_numpy(f)[None], torch.from_numpy(begin * free)[None], exactness)
        step: Array = least[0].numpy()
        return step[:-6], cv2.Rodrigues(step[-6:-3])[0] @ R, t + step[-3:]


def _turn(start: Array, end: Array) -> Array:
    """The rotation vector (3,) from a rotation (3,3) to another; see ``rotation_between``."""
    turned = end @ start.T
    axis = 0.5 * np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
    sine = math.sqrt(axis @ axis)
    return axis * (math.atan2(sine, 0.5 * (turned.trace() - 1)) / sine if sine > 1e-12 else 1.0)


def _weaker(weights: Array, signed: Array) -> Array:
    """Which of weights (N,) are the smaller of two antagonists; see ``weaker_sides``."""
    difference = signed @ weights
    return np.where(np.abs(difference) > _NOTHING, np.sign(difference), 0.0) @ signed < 0
