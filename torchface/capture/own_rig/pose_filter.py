"""Head poses filtered along time: rotation and translation together, each as certain as the landmarks make it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.geometry.rotations import rotation_matrix, rotation_vector

# What is known of the first velocity and acceleration: deviations, radians and millimetres a frame and a frame².
_FIRST_VELOCITY, _FIRST_ACCELERATION = (0.1, 15.0), (0.02, 3.0)
# Squared Mahalanobis distance of a pose that cannot follow from those before, whatever the motion; this often in
# succession, and the head is elsewhere.
_GATE, _PATIENCE = 150.0, 4


@dataclass(frozen=True)
class PoseFilterSettings:
    r"""The motions and noises that a pose filter reckons with; time counts in frames.

    One filter runs for each of their combinations, and each counts as much as it has foretold the last frames well:
    a head that is still is smoothed more than one that moves.

    Args:
        noise: deviations of a landmark, pixels.
        turning: deviations of what the angular acceleration changes by in a frame, radians a frame².
        moving: the same of the translation, millimetres a frame².
        fading: what is left of an acceleration after a frame; 1 is constant acceleration. Heads turn back soon, so
            that a little less foretells better and does not run away in gaps.
        calm: share of each motion's credit that goes to the next calmer one: what is most likely still jitters more
            than eyes forgive, and a little calmer is hardly less exact.
        memory: frames after which a forecast counts 1/e.
        longest_gap: frames without a pose that are bridged by prediction; then the head counts as lost.
    """

    noise: tuple[float, ...] = (0.2, 0.6, 1.5, 4.0)
    turning: tuple[float, ...] = (1e-5, 3.3e-5, 1.1e-4, 3.6e-4, 1.2e-3, 4e-3)
    moving: tuple[float, ...] = (1e-3, 3.3e-3, 0.011, 0.036, 0.12, 0.4)
    fading: float = 0.92
    calm: float = 0.3
    memory: float = 30.0
    longest_gap: int = 10

    def __post_init__(self) -> None:
        for name in ("noise", "turning", "moving"):
            values = getattr(self, name)
            if not values or not all(0 < value < float("inf") for value in values):
                raise ValueRangeError(f"{name}: found {values}, expected positive deviations, one at least")
        if self.longest_gap < 0 or not self.memory > 0 or not (0 <= self.fading <= 1 and 0 <= self.calm <= 1):
            raise ValueRangeError(
                f"pose filter: found longest_gap {self.longest_gap}, memory {self.memory}, fading {self.fading} and "
                f"calm {self.calm}, expected a gap from 0, positive frames, 0 to 1 and 0 to 1"
            )


@dataclass(frozen=True, eq=False)
class _Estimates:
    """What a frame is believed to be, by each model: poses, velocities and accelerations, and how certain they are.

    Args:
        rotation: (M,3,3).
        place: translation, (M,3).
        rate: velocity and acceleration of turn and move, (M,2,6).
        covariance: of turn and move, their velocities and their accelerations, (M,18,18).
    """

    rotation: Tensor
    place: Tensor
    rate: Tensor
    covariance: Tensor


class PoseFilter:
    r"""A causal filter of (slowly fading) acceleration for rigid motion.

    .. math::
        R_t = \exp([\omega + \tfrac12 \alpha]) R_{t-1}, \quad p_t = p_{t-1} + v + \tfrac12 a, \quad
        (\omega, v)_t = (\omega, v)_{t-1} + (\alpha, a), \quad (\alpha, a)_t = \rho (\alpha, a)_{t-1} + \text{jerk}

    What is estimated of a rotation is the small turn away from the predicted one, so that there is no sign to choose,
    as there is of quaternions, and every answer is a rotation.

    Args:
        settings: motions and noises.

    Source: Kalman 1960; Singer 1970; Magill 1965; Lefferts, Markley, Shuster 1982; thesis 4.2.5.
    """

    def __init__(self, settings: PoseFilterSettings) -> None:
        self.settings = settings
        self.scores = torch.zeros(0, dtype=torch.float64)
        """What each model's forecasts were worth, logarithms of probability, (M,)."""
        noise, turning, moving = torch.meshgrid(
            *(torch.tensor(v, dtype=torch.float64) for v in (settings.noise, settings.turning, settings.moving)),
            indexing="ij",
        )
        self._variance = noise.flatten().square()
        jerk = torch.stack([turning.flatten()] * 3 + [moving.flatten()] * 3, dim=1).square()
        shares = torch.tensor([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1]], dtype=torch.float64)
        self._drift = torch.einsum("ab,mi,ij->maibj", shares, jerk, torch.eye(6, dtype=torch.float64)).reshape(
            -1, 18, 18
        )
        self._steps = torch.tensor([[1, 1, 0.5], [0, 1, 1], [0, 0, settings.fading]], dtype=torch.float64)
        self.estimate: _Estimates | None = None
        self.began = False
        """Whether the last frame began anew, whatever was before."""
        self._unseen = self._odd = 0

    def to(self, device: torch.device) -> PoseFilter:
        """The filter itself, with all that it holds on a device; ``correct`` follows its poses there."""
        if self._steps.device != device:
            for name in ("scores", "_variance", "_drift", "_steps"):
                setattr(self, name, getattr(self, name).to(device))
            if self.estimate is not None:
                self.estimate = _Estimates(*(part.to(device) for part in vars(self.estimate).values()))
        return self

    def predict(self) -> None:
        """Goes one frame on."""
        if self.estimate is None:
            return
        b = self.estimate
        velocity, acceleration = b.rate.unbind(1)
        step = velocity + 0.5 * acceleration
        self.estimate = _Estimates(
            rotation_matrix(step[:, :3]) @ b.rotation,
            b.place + step[:, 3:],
            torch.stack([velocity + acceleration, self.settings.fading * acceleration], dim=1),
            self.moved(self.moved(b.covariance).transpose(1, 2)) + self._drift,
        )

    def moved(self, covariance: Tensor) -> Tensor:
        """The transition, which mixes place, velocity and acceleration alike for all six, times covariances."""
        return (self._steps @ covariance.reshape(-1, 3, 6 * 18)).reshape(-1, 18, 18)

    def correct(self, rotation: Tensor, translation: Tensor, covariance: Tensor) -> None:
        """Takes in a frame's pose (3,3), (3,) with its covariance (6,6) at one pixel of noise; NaN where not found."""
        self.to(translation.device).began = False
        if not bool(torch.isfinite(translation).all()):
            self._missed()
            return
        noise = self._variance[:, None, None] * covariance
        if self.estimate is None:
            self._begin(rotation, translation, noise)
            return
        b = self.estimate
        off = torch.cat([rotation_vector(rotation @ b.rotation.transpose(1, 2)), translation - b.place], dim=1)
        spread = torch.linalg.cholesky(_symmetric(b.covariance[:, :6, :6] + noise))
        whitened = torch.linalg.solve_triangular(spread, off[..., None], upper=False)
        squared = whitened[..., 0].square().sum(1)
        if float(squared.min()) > _GATE:
            self._odd += 1
            if self._odd >= _PATIENCE:
                self._begin(rotation, translation, noise)
            else:
                self._missed()
            return
        self._odd = self._unseen = 0
        certainty = -0.5 * squared - spread.diagonal(dim1=1, dim2=2).log().sum(1)
        self.scores = self.scores * (1 - 1 / max(self.settings.memory, 1.0)) + certainty
        # The gain is W L⁻¹ with S = L Lᵀ, and what is learned of the covariance W Wᵀ: symmetric whatever is rounded.
        learned = torch.linalg.solve_triangular(spread, b.covariance[:, :6], upper=False).transpose(1, 2)
        change = (learned @ whitened)[..., 0]
        self.estimate = _Estimates(
            _orthonormal(rotation_matrix(change[:, :3]) @ b.rotation),
            b.place + change[:, 3:6],
            b.rate + change[:, 6:].reshape(-1, 2, 6),
            b.covariance - learned @ learned.transpose(1, 2),
        )

    def pose(self) -> tuple[Tensor, Tensor]:
        """Rotation (3,3) and translation (3,) as all models together have it; NaN where the head is lost."""
        if self.estimate is None:
            return self._steps.new_full((3, 3), torch.nan), self._steps.new_full((3,), torch.nan)
        share = self._shares()
        best = self.estimate.rotation[int(share.argmax())]
        rotation_vectors = rotation_vector(self.estimate.rotation @ best.T)
        return rotation_matrix(share @ rotation_vectors) @ best, share @ self.estimate.place

    def likeliest(self) -> tuple[Tensor, Tensor]:
        """Rotation (3,3) and translation (3,) of the model that has foretold best; NaN where the head is lost."""
        if self.estimate is None:
            return self.pose()
        best = int(self.scores.argmax())
        return self.estimate.rotation[best], self.estimate.place[best]

    def _shares(self) -> Tensor:
        """How much each model counts, (M,)."""
        settings = self.settings
        likely = torch.softmax(self.scores, dim=0).reshape(len(settings.noise), len(settings.turning), -1)
        calmer = likely
        for axis in (1, 2):  # turning, then moving
            first, rest = calmer.narrow(axis, 0, 1), calmer.narrow(axis, 1, calmer.shape[axis] - 1)
            calmer = torch.cat([rest, torch.zeros_like(first)], dim=axis)
            calmer.narrow(axis, 0, 1).add_(first)
        return torch.lerp(likely, calmer, settings.calm).flatten()

    def _begin(self, rotation: Tensor, translation: Tensor, noise: Tensor) -> None:
        models = len(noise)
        known = noise.new_tensor([_FIRST_VELOCITY, _FIRST_ACCELERATION])
        covariance = noise.new_zeros(models, 18, 18)
        covariance[:, :6, :6] = _symmetric(noise)
        covariance[:, range(6, 18), range(6, 18)] = known.repeat_interleave(3, dim=1).flatten().square()
        rotation = _orthonormal(rotation.double()).expand(models, 3, 3)
        rate = noise.new_zeros(models, 2, 6)
        self.estimate = _Estimates(rotation, translation.double().expand(models, 3), rate, covariance)
        self._unseen = self._odd = 0
        self.began = True
        if not len(self.scores):
            self.scores = noise.new_zeros(models)

    def _missed(self) -> None:
        self._unseen += 1
        if self._unseen > self.settings.longest_gap:
            self.estimate = None


def _orthonormal(rotations: Tensor) -> Tensor:
    """What is a rotation up to rounding, without it: a step of Newton's method for the polar factor."""
    identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
    return rotations @ (3 * identity - rotations.transpose(-1, -2) @ rotations) / 2


def _symmetric(matrices: Tensor) -> Tensor:
    return 0.5 * (matrices + matrices.transpose(-1, -2))


def smooth_rigid_motion(
    rotation: Tensor, translation: Tensor, covariance: Tensor, settings: PoseFilterSettings
) -> tuple[Tensor, Tensor]:
    """Poses from all frames, those after each too, by the one combination of noise and motion that is most likely.

    Args:
        rotation, translation: measured, (T,3,3) and (T,3), NaN where not found.
        covariance: of each at one pixel of noise, (T,6,6).
        settings: motions and noises to choose from. Longer gaps than ``longest_gap`` stay NaN, as does what is before
            the first pose.

    Returns:
        Rotations (T,3,3) and translations (T,3).

    Source: Rauch, Tung, Striebel 1965.
    """
    endless = replace(settings, memory=float("inf"), longest_gap=len(rotation))
    running = PoseFilter(endless)
    for frame in zip(rotation, translation, covariance, strict=True):  # a frame needs the one before
        running.predict()
        running.correct(*frame)
    if running.estimate is None:
        return torch.full_like(rotation, torch.nan), torch.full_like(translation, torch.nan)
    combinations = list(itertools.product(settings.noise, settings.turning, settings.moving))
    noise, turning, moving = combinations[int(running.scores.argmax())]
    running = PoseFilter(replace(endless, noise=(noise,), turning=(turning,), moving=(moving,)))
    ahead, here, began = [], [], []
    for frame in zip(rotation, translation, covariance, strict=True):
        running.predict()
        ahead.append(running.estimate)
        running.correct(*frame)
        here.append(running.estimate)
        began.append(running.began)
    kept = here[-1]
    smoothed = [kept]
    for t in range(len(rotation) - 2, -1, -1):  # backward, a frame needs the one after
        kept = here[t] if began[t + 1] else _smoothed(here[t], ahead[t + 1], kept, running)
        smoothed.append(kept)
    turned, moved = rotation.double().clone(), translation.double().clone()
    for t, estimate in enumerate(reversed(smoothed)):
        turned[t] = torch.nan if estimate is None else estimate.rotation[0]
        moved[t] = torch.nan if estimate is None else estimate.place[0]
    lost = _long_gaps(torch.isfinite(translation).all(1), settings.longest_gap)
    turned[lost], moved[lost] = torch.nan, torch.nan
    return turned, moved


def _smoothed(
    here: _Estimates | None, ahead: _Estimates | None, after: _Estimates | None, running: PoseFilter
) -> _Estimates | None:
    """What a frame was, now that the one after is known; ``ahead`` is what was foretold of that one."""
    if here is None or ahead is None or after is None:
        return here
    gain = torch.linalg.solve(ahead.covariance, running.moved(here.covariance)).transpose(1, 2)
    off = torch.cat(
        [
            rotation_vector(after.rotation @ ahead.rotation.transpose(1, 2)),
            after.place - ahead.place,
            (after.rate - ahead.rate).flatten(1),
        ],
        dim=1,
    )
    change = (gain @ off[..., None])[..., 0]
    return _Estimates(
        _orthonormal(rotation_matrix(change[:, :3]) @ here.rotation),
        here.place + change[:, 3:6],
        here.rate + change[:, 6:].reshape(-1, 2, 6),
        here.covariance,
    )


def _long_gaps(seen: Tensor, longest: int) -> Tensor:
    """Frames (T,) in runs of more than ``longest`` that were not seen."""
    lost, run = torch.zeros_like(seen), 0
    for t, found in enumerate([*seen.tolist(), True]):
        if found and run > longest:
            lost[t - run : t] = True
        run = 0 if found else run + 1
    return lost
