"""The video solve of one frame with a fixed number of steps, as it goes into an ONNX graph."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from torchface.capture.priors import ShapePrior, StudentDensity
from torchface.capture.video.face_points import LANDMARKS
from torchface.capture.video.reprojection import HeadState, linearise
from torchface.capture.video.solver_components import LOOSE_PLACE, LOOSE_STEP, LOOSE_TURN, LOOSE_WEIGHT, SHIFT, TURN
from torchface.capture.video.video_solver import VideoSolver
from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.rotations import cross_matrix
from torchface.onnx.symmetric_inverse import swept_inverse
from torchface.optim.splitting import RELAXATION

_SLIDING_STEPS = 3
_FEWEST = 6
_SPLITTING_STEPS = 40  # in one of Gauss and Newton
_RHO = 0.05
_TERMS = 24  # of a series; exact to 1e-7 for turns of up to 90 degrees


@dataclass(frozen=True, eq=False)
class _Bell:
    """Student's distribution of a group of so many shapes; the matrix is of all, (N,N)."""

    size: int
    freedom: float
    strength: float
    matrix: Tensor


class VideoGraph(nn.Module):
    r"""``VideoSolver.step`` as products, clamps and choices alone, one frame with what it hands on to the next.

    The energy is that of ``VideoSolver``, in float64 inside and float32 outside. A step is one of Gauss and Newton,
    whose program in the box is solved by a fixed number of steps of splitting; their matrix is inverted by sweeps. Each
    frame takes as many steps as the settings allow, and keeps what it had once none moved a weight further than their
    tolerance: then it is where the solver stops. Contour landmarks slide, chosen anew in the first steps. The first
    frame's pose is that of an affine camera, so that nothing else need be known.

    Without a dynamics prior the state is ``weights``, ``rotation`` and ``translation``. With one it is ``rotation``,
    ``translation``, and

    - ``window``: the latest frames' weights, (J,N), the newest last, NaN for those that have not been;
    - ``mean``: what landmarks and dynamics alone told, weights and motion from the pose, (N+6,);
    - ``covariance``: of that, (N+6,N+6).

    Inputs are ``landmarks``, ``confidence`` and the state with ``previous_`` before its names; outputs ``weights``,
    ``rotation``, ``translation`` and the rest of the state. A state with a NaN in ``previous_rotation`` is none: the
    frame is a first one. A first frame with fewer than six landmarks hands on no state either.

    Args:
        solver: the exact solve, with its settings; its tracked poses count for nothing.

    Raises:
        ValueRangeError: the solver leans on tracked poses, or its prior is none of Student's distributions.

    Source: thesis 4.2.6, 4.2.9, 4.2.10; Boyd et al. 2011, 3.4.3 and 5.2, for the splitting.
    """

    def __init__(self, solver: VideoSolver) -> None:
        super().__init__()
        self.settings = solver.settings
        if self.settings.pose_trust > 0:
            raise ValueRangeError(f"video graph: found a pose_trust of {self.settings.pose_trust}, expected 0")
        self.names, self.points = solver.names, solver.points
        self.dynamics = copy.deepcopy(solver.dynamics)
        self.window = 1 if self.dynamics is None else self.dynamics.window
        count, like = len(solver.names), solver.points.rest
        self.bells = _bells(solver.prior, count, like)
        self.intrinsics, self.landmark_weights = solver.intrinsics.double(), solver.landmark_weights.double()
        self.to_rays = torch.linalg.inv(self.intrinsics).T
        self.loose = solver.loose.double().diag()
        self.loose_spread = like.new_tensor(
            [LOOSE_WEIGHT**2] * count + [LOOSE_TURN**2] * 3 + [LOOSE_PLACE**2] * 3
        ).diag()
        self.motion = like.new_tensor([TURN**2] * 3 + [SHIFT**2] * 3)
        self.identity = torch.eye(count + 6).to(like)
        free = like.new_full((6,), 1e9)
        self.lower = torch.cat([like.new_zeros(count), -free])
        self.upper = torch.cat([like.new_ones(count), free])

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of what ``forward`` returns."""
        own = ("weights", "rotation", "translation")
        return own if self.dynamics is None else (*own, "window", "mean", "covariance")

    @property
    def state(self) -> tuple[str, ...]:
        """Names of the outputs that the next frame takes, in the order of its arguments."""
        return self.outputs if self.dynamics is None else self.outputs[1:]

    def start(self) -> tuple[Tensor, ...]:
        """The state before the first frame: NaN."""
        count = len(self.names)
        shapes = {"weights": (count,), "rotation": (3, 3), "translation": (3,), "window": (self.window, count)}
        shapes |= {"mean": (count + 6,), "covariance": (count + 6, count + 6)}
        return tuple(torch.full(shapes[name], torch.nan) for name in self.state)

    def forward(self, landmarks: Tensor, confidence: Tensor, *previous: Tensor) -> tuple[Tensor, ...]:
        """The frame's ``outputs``.

        Args:
            landmarks: (68,2), pixels; NaN for not seen.
            confidence: how far each is trusted, (68,) in [0,1].
            previous: the ``state`` of the frame before, or ``start()``.

        Raises:
            ShapeError: an argument is not as above.
        """
        if landmarks.shape != (LANDMARKS, 2) or confidence.shape != (LANDMARKS,) or len(previous) != len(self.state):
            raise ShapeError(
                f"video graph: found landmarks {tuple(landmarks.shape)}, confidence {tuple(confidence.shape)} and "
                f"{len(previous)} parts of a state, expected ({LANDMARKS},2), ({LANDMARKS},) and {len(self.state)}"
            )
        state = {name: value.double() for name, value in zip(self.state, previous, strict=True)}
        unseen = torch.isnan(landmarks).any(1)
        found = torch.where(unseen[:, None], 0.0, landmarks.double())
        trust = torch.where(unseen, 0.0, self.landmark_weights * confidence.double())
        enough = (~unseen).double().sum() > _FEWEST - 0.5
        first = torch.isnan(state["rotation"]).any()
        rotation, translation = self._affine_pose(found, trust)
        rotation = torch.where(first, rotation, _orthonormal(state["rotation"]))
        translation = torch.where(first, translation, state["translation"])
        window = state["weights"][None] if self.dynamics is None else state["window"]
        weights = torch.where(first, 0.0, window[-1]).clamp(0, 1)
        head = HeadState(weights[None], rotation[None], translation[None])
        mean, information = self._expected(head, window, first, state)
        apart = self.points.eyes_distance(head.rotation, head.translation, self.intrinsics)
        noise = (self.settings.relative_noise * apart).clamp(min=self.settings.pixel_noise)
        precision = torch.where(enough, trust.sqrt() / noise, 0.0)[None]
        rows = self.points.chosen(head.weights, head.rotation, head.translation, self.intrinsics)
        dual, done = torch.zeros_like(self.lower), torch.zeros_like(first)
        for step in range(self.settings.steps):  # each step begins where the one before ended
            if 0 < step < _SLIDING_STEPS:
                rows = self.points.chosen(head.weights, head.rotation, head.translation, self.intrinsics)
            H, gradient = self._told(head, rows, found[None], precision, mean, information)
            own, slope = self._liked(head.weights[0])
            factors = self._factors(H + torch.nn.functional.pad(own, (0, 6, 0, 6)))
            gradient = gradient + torch.nn.functional.pad(slope, (0, 6))
            by, dual = self._step(head.weights[0], gradient, factors, dual)
            head = _chosen(done, head, self._moved(head, by))
            done = done | (by[: len(self.names)].abs().max() < self.settings.tolerance)
        # A face that is not seen stays as it was.
        head = _chosen(enough, head, HeadState(weights[None], rotation[None], translation[None]))
        begun = ~first | enough
        out = [
            torch.where(begun, head.weights[0], 0.0),
            torch.where(begun, head.rotation[0], torch.nan),
            head.translation[0],
        ]
        if self.dynamics is not None:
            H, gradient = self._told(head, rows, found[None], precision, mean, information)
            covariance = swept_inverse(H)
            least = torch.nn.functional.pad(head.weights[0], (0, 6)) - covariance @ gradient
            kept = torch.where(first, torch.full_like(window, torch.nan), window)
            window = torch.cat([kept, head.weights])[-self.window :]
            out += [window, least, 0.5 * (covariance + covariance.T)]
        return tuple(value.float() for value in out)

    def _affine_pose(self, found: Tensor, trust: Tensor) -> tuple[Tensor, Tensor]:
        """The pose (3,3), (3,) in which an affine camera sees the rig at rest as landmarks (68,2) are."""
        rest = self.points.rest[:LANDMARKS]
        rays = torch.nn.functional.pad(found, (0, 1), value=1.0) @ self.to_rays
        rays = rays[:, :2] / rays[:, 2:]
        share = (trust / trust.sum())[:, None]
        centre, middle = (share * rest).sum(0), (share * rays).sum(0)
        x, q = (rest - centre) * share, rays - middle
        spread = swept_inverse((rest - centre).T @ x)
        across = (q.T @ x) @ spread
        size = across.square().sum(1).sqrt()
        rotation = _orthonormal(torch.cat([across, across[:1]]))
        depth = 2 / (size[0] + size[1])
        return rotation, depth * torch.nn.functional.pad(middle, (0, 1), value=1.0) - rotation @ centre

    def _expected(
        self, head: HeadState, window: Tensor, first: Tensor, state: dict[str, Tensor]
    ) -> tuple[HeadState, Tensor]:
        """What the frames before tell of this one: the mean and its information (N+6,N+6)."""
        if self.dynamics is None:
            return HeadState(torch.zeros_like(head.weights), head.rotation, head.translation), self.loose
        gaps = torch.isnan(window)
        full = ~gaps.any()
        known = torch.where(gaps, 0.0, window)
        ahead, variance = self.dynamics(known.to(self.dynamics.center.dtype)[None])
        steps = torch.where(full, ahead[0].double() - known[-1], 0.0)
        variance = torch.where(full, variance[0].double() / self.settings.dynamics_strength, LOOSE_STEP**2)
        least = torch.where(first, 0.0, state["mean"] + torch.nn.functional.pad(steps, (0, 6)))
        noise = torch.cat([variance, self.motion])[:, None] * self.identity
        spread = torch.where(first, self.loose_spread, state["covariance"] + noise)
        return self._moved(head, least - torch.nn.functional.pad(head.weights[0], (0, 6))), swept_inverse(spread)

    def _told(
        self, head: HeadState, rows: Tensor, found: Tensor, precision: Tensor, mean: HeadState, information: Tensor
    ) -> tuple[Tensor, Tensor]:
        """What landmarks and the frames before tell: H (N+6,N+6), and the gradient (N+6,) at a state."""
        at = linearise(self.points, head, rows, self.intrinsics, found, precision, self.settings.contour_slide)
        J, r = at.jacobian[0].flatten(0, 1), at.residual[0].flatten()
        away = torch.cat(
            [
                head.weights[0] - mean.weights[0],
                _turn_between(mean.rotation[0], head.rotation[0]),
                head.translation[0] - mean.translation[0],
            ]
        )
        return J.T @ J + information, r @ J + information @ away

    def _liked(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """What prior and prices ask: H (N,N), and the gradient (N,) at weights (N,)."""
        H = 2 * self.settings.ridge * self.identity[:-6, :-6]
        for bell in self.bells:
            distance = weights @ bell.matrix @ weights
            H = H + (bell.freedom + bell.size) / (bell.freedom + distance) * bell.strength * bell.matrix
        return H, H @ weights + self.settings.sparsity

    def _factors(self, H: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """G, 2G + (2 - α) I and -α (H + ρD)^-1 of splitting, (N+6,N+6) each; see ``torchface.optim.splitting``."""
        diagonal = (H * self.identity).sum(0)
        offset = -RELAXATION * swept_inverse(H + _RHO * diagonal * self.identity)
        step = -_RHO * diagonal[:, None] * offset - self.identity
        return step, 2 * step + (2 - RELAXATION) * self.identity, offset

    def _step(
        self, weights: Tensor, gradient: Tensor, factors: tuple[Tensor, Tensor, Tensor], dual: Tensor
    ) -> tuple[Tensor, Tensor]:
        """By what weights and pose should move, (N+6,), and the scaled dual there, (N+6,)."""
        step, double_step, offset = factors
        lower = self.lower - torch.nn.functional.pad(weights, (0, 6))
        upper = self.upper - torch.nn.functional.pad(weights, (0, 6))
        constant = gradient[None] @ offset
        v, z = dual[None], torch.zeros_like(constant)
        for _ in range(_SPLITTING_STEPS):  # each needs the one before
            v = torch.addmm(torch.addmm(constant, v, step, alpha=-1.0), z, double_step)
            z = torch.minimum(torch.maximum(v, lower), upper)
        return z[0], torch.nn.functional.pad((v - z)[0, : len(weights)], (0, 6))

    def _moved(self, head: HeadState, by: Tensor) -> HeadState:
        """A state whose weights and pose are moved by (N+6,)."""
        shapes = len(self.names)
        turn, shift = by[shapes : shapes + 3], by[shapes + 3 :]
        return HeadState(
            head.weights + by[None, :shapes], (_turned(turn) @ head.rotation[0])[None], head.translation + shift[None]
        )


def _bells(prior: ShapePrior | None, shapes: int, like: Tensor) -> list[_Bell]:
    """The prior's groups, (N,N) each."""
    if prior is None:
        return []
    parts = []
    for group, density in zip(prior.groups, prior.densities, strict=True):
        if type(prior) is not ShapePrior or not isinstance(density, StudentDensity):
            raise ValueRangeError(
                f"video graph: found a {type(prior).__name__} of {type(density).__name__}, expected one of Student's "
                "distributions, as ShapePrior.fit learns"
            )
        rows = torch.tensor(group)
        factor = density.factor.to(like)
        matrix = like.new_zeros(shapes, shapes)
        matrix[rows[:, None], rows] = factor @ factor.T
        parts.append(_Bell(len(group), float(density.degrees_of_freedom), prior.strength, matrix))
    return parts


def _chosen(condition: Tensor, one: HeadState, other: HeadState) -> HeadState:
    return HeadState(
        torch.where(condition, one.weights, other.weights),
        torch.where(condition, one.rotation, other.rotation),
        torch.where(condition, one.translation, other.translation),
    )


def _turned(vector: Tensor) -> Tensor:
    """The rotation (3,3) about a vector (3,) by its length."""
    square = vector.square().sum() + 1e-24
    angle = square.sqrt()
    cross = cross_matrix(vector)
    near = torch.from_numpy(np.eye(3)) + angle.sin() / angle * cross
    return near + 2 * (0.5 * angle).sin().square() / square * (cross @ cross)


def _turn_between(start: Tensor, end: Tensor) -> Tensor:
    """The vector (3,) of the turn from one rotation (3,3) to another."""
    turn = end @ start.T
    axis = 0.5 * torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    half = (0.25 * (3 - (turn[0, 0] + turn[1, 1] + turn[2, 2]))).clamp(0, 0.6)  # sin²(θ/2)
    # θ/sin θ in powers of it: 1, 2/3, 8/15, ...; ONNX has no arc sine of float64.
    factor = (half ** torch.from_numpy(np.arange(_TERMS, dtype=np.float64)) * _series(half)).sum()
    return factor * axis


def _series(like: Tensor) -> Tensor:
    """1, 2/3, 8/15, ...: coefficients of θ/sin θ in powers of sin²(θ/2)."""
    order = np.arange(1, _TERMS)
    return torch.from_numpy(np.cumprod(np.concatenate([[1.0], 2 * order / (2 * order + 1)]))).to(like)


def _orthonormal(matrix: Tensor) -> Tensor:
    """The rotation (3,3) of a matrix' first two rows (3,3)."""
    first = matrix[0] / matrix[0].square().sum().sqrt()
    second = matrix[1] - (first @ matrix[1]) * first
    second = second / second.square().sum().sqrt()
    third = torch.stack(
        [
            first[1] * second[2] - first[2] * second[1],
            first[2] * second[0] - first[0] * second[2],
            first[0] * second[1] - first[1] * second[0],
        ]
    )
    return torch.stack([first, second, third])
