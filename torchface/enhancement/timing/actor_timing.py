"""The actor's timing of motions between keyframes, by region: learned where the database has motions enough.

A learned timing is a regression from where a motion begins and ends, and how long it lasts, to its velocity.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from torchface.enhancement.timing.motion_keyframes import find_keyframes, without_holds
from torchface.enhancement.timing.nearest_timing import (
    captured_sequences,
    check_keyframes,
    moving_regions,
    nearest_timing,
)
from torchface.errors import ValueRangeError
from torchface.number_checks import checked_count, checked_number

LEAST_MOTIONS = 12  # how many captured motions a region needs: of fewer no regression is learned
_MOMENTS = 40  # at which a velocity profile is known
_DIRECTIONS = 2  # principal components of a region's poses; more were no better on takes left out
_BEND = 0.3  # of a sequence's range: how far a motion may leave the straight way and be one motion still
_SMALL = 0.1  # of a region's usual motion: less is taken for noise
_USUAL = 0.95  # quantile of motions' sizes
_MOST_TUNED = 200  # motions of which the scales are learned
_STEPS, _RATE = 60, 0.1  # of the descent on the scales
_LEAST_RIDGE = 1e-4  # of the kernel's diagonal
_FEWER_INPUTS = 1e-3  # how much the descent prefers inputs that count for nothing


class ActorTiming:
    """How the captured actor moves between two poses.

    A region of enough captured motions has a regression of its own, :class:`LearnedTiming`; any other takes the mean of
    its nearest motions, ``nearest_timing``; one at rest follows the whole face.
    """

    def __init__(self, database: Tensor, sequences: Tensor, weights: Tensor, fps: float) -> None:
        self._captured = captured_sequences(database, sequences)
        self._weights = weights
        self._whole = weights.mean(0)
        self._learned = [LearnedTiming.fit(database, sequences, region, fps) for region in (*weights, self._whole)]

    def times(self, keyframes: Tensor, frames: int, length: float, extend: bool = True) -> Tensor:
        """How far the motion between two keyframes has come in each frame, (R,frames), 0 first, 1 last, never falling.

        ``length`` is in frames of the database. With ``extend`` to the whole motion of which the keyframes meet a part:
        regressions know whole motions alone, so the nearest motions are taken otherwise.
        """
        checked_count("frames", frames, 2)
        checked_number("length", length, above=True)
        check_keyframes(keyframes, self._captured[0].shape[1:])
        moves = moving_regions(keyframes, self._weights)
        regressions = self._learned if extend else [None] * len(self._learned)

        def region_times(row: int, region: Tensor) -> Tensor:
            regression = regressions[row]
            if regression is not None:
                return regression.times(keyframes, frames, length)
            return nearest_timing(keyframes, self._captured, region, frames, length, extend=extend)

        whole = region_times(-1, self._whole)
        rows = [
            region_times(row, region) if moves[row] else whole
            for row, region in enumerate(self._weights)  # each has a regression of its own
        ]
        return torch.stack(rows)


@dataclass(frozen=True, eq=False)
class LearnedTiming:
    """Velocity profiles of one region's motions, by kernel ridge regression on pose, way and length."""

    scale: Tensor  # square roots of the region's shares in the patches, (P,1)
    # centre, directions: of the region's poses, (D,) and (D,q)
    centre: Tensor
    directions: Tensor
    # mean, deviation: of the inputs, (c,)
    mean: Tensor
    deviation: Tensor
    inputs: Tensor  # of the captured motions, (m,c), each multiplied by its inverse length scale
    inverse_lengths: Tensor  # the inverse length scales, (c,)
    mean_profile: Tensor  # velocities in the mean of all motions, (40,), 1 in the mean
    dual: Tensor  # coefficients of the motions, (m,40)

    @classmethod
    def fit(cls, database: Tensor, sequences: Tensor, region: Tensor, fps: float) -> "LearnedTiming | None":
        """Learns from captured sequences, cut into motions where they turn; None from few motions.

        The inverse length scales and the ridge have the least leave-one-out error, which has a closed form.
        """
        scale = region.detach().double().clamp(min=0).sqrt()[:, None].clone()
        frames = (database.detach().double() * scale).flatten(1)
        motions = _motions(frames, sequences, fps)
        if len(motions) < LEAST_MOTIONS:
            return None
        ends = torch.stack([motion[[0, -1]] for motion in motions])
        centre = ends.flatten(0, 1).mean(0)
        _, _, directions = torch.linalg.svd(ends.flatten(0, 1) - centre, full_matrices=False)
        directions = directions[:_DIRECTIONS].T.contiguous()
        lengths = torch.tensor([len(motion) - 1.0 for motion in motions], dtype=torch.float64)
        inputs = _inputs(ends, lengths, centre, directions)
        mean, deviation = inputs.mean(0), inputs.std(0).clamp(min=1e-9)
        inputs = (inputs - mean) / deviation
        profiles = torch.stack([_velocities(motion) for motion in motions])
        mean_profile = profiles.mean(0)
        inverse_lengths, ridge = _least_left_out(inputs, profiles)
        inputs = inputs * inverse_lengths
        kernel = _kernel(inputs, inputs) + ridge * torch.eye(len(inputs), dtype=torch.float64)
        dual = torch.linalg.solve(kernel, profiles - mean_profile)
        return cls(scale, centre, directions, mean, deviation, inputs, inverse_lengths, mean_profile, dual)

    def times(self, keyframes: Tensor, frames: int, length: float) -> Tensor:
        """How far the motion of ``length`` frames between keyframes (2,P,C) has come, (frames,), from 0 to 1, never
        falling."""
        checked_count("frames", frames, 2)
        checked_number("length", length, above=True)
        pair = (keyframes.detach().double() * self.scale).flatten(1)
        if not float((pair[1] - pair[0]).norm()) > 0:
            raise ValueRangeError("keyframes: found two that are equal, expected a motion between them")
        asked = torch.tensor([length], dtype=torch.float64)
        inputs = (_inputs(pair[None], asked, self.centre, self.directions) - self.mean) / self.deviation
        inputs = inputs * self.inverse_lengths
        # Velocity does not go below nothing: time never runs backwards.
        velocity = (self.mean_profile + _kernel(inputs, self.inputs)[0] @ self.dual).clamp(min=0)
        way = torch.cat([velocity.new_zeros(1), velocity.cumsum(0)])
        times = _evenly(way, frames) / way[-1]
        times[0], times[-1] = 0, 1
        return times.to(keyframes.dtype)


def _motions(frames: Tensor, sequences: Tensor, fps: float) -> list[Tensor]:
    """The motions of captured sequences between holds and turns, (n,D) each; what hardly moves is left out."""
    motions = []
    for number in sequences.unique():  # of different length
        path = frames[sequences == number]
        if len(path) < 2:
            continue
        for first, last in pairwise(find_keyframes(path, _BEND)):
            begin, end = without_holds(path[first : last + 1], fps)
            if end > begin:
                motions.append(path[first + begin : first + end + 1])
    if not motions:
        return []
    sizes = torch.stack([(motion[-1] - motion[0]).norm() for motion in motions])
    least = _SMALL * float(sizes.quantile(_USUAL))
    return [motion for motion, size in zip(motions, sizes.tolist(), strict=True) if size > max(least, 0.0)]


def _velocities(motion: Tensor) -> Tensor:
    """Along the straight way from a motion's (n,D) first to its last pose, (40,), 1 in the mean."""
    way = motion[-1] - motion[0]
    progress = (motion - motion[0]) @ way / way.square().sum()
    return _MOMENTS * _evenly(progress, _MOMENTS + 1).diff()


def _evenly(values: Tensor, count: int) -> Tensor:
    """Values (n,) at ``count`` even moments from the first to the last, between them linearly."""
    moments = np.linspace(0, len(values) - 1, count)
    return torch.from_numpy(np.interp(moments, np.arange(len(values)), values.numpy()))


def _inputs(ends: Tensor, lengths: Tensor, centre: Tensor, directions: Tensor) -> Tensor:
    """What a motion's velocity is predicted from, (m,2+3q), of its ends (m,2,D) and lengths (m,)."""
    places = (ends - centre) @ directions
    way = ends[:, 1] - ends[:, 0]
    size = way.norm(dim=1).clamp(min=1e-12)
    heading = way @ directions / size[:, None]
    return torch.cat([lengths.log()[:, None], size.log()[:, None], places.flatten(1), heading], 1)


def _kernel(left: Tensor, right: Tensor) -> Tensor:
    squared = left.square().sum(1)[:, None] - 2 * left @ right.T + right.square().sum(1)
    return torch.exp(-0.5 * squared.clamp(min=0))


def _least_left_out(inputs: Tensor, profiles: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse length scales (c,) and the ridge with which each motion is best predicted from the others."""
    some = torch.linspace(0, len(inputs) - 1, min(len(inputs), _MOST_TUNED)).long()
    # A caller's inference mode would forbid the descent.
    with torch.inference_mode(False), torch.enable_grad():
        known = inputs[some].clone()
        wanted = (profiles - profiles.mean(0))[some].clone()
        logarithms = torch.full((known.shape[1] + 1,), -1.2, dtype=torch.float64)
        logarithms[-1] = 0.0
        logarithms.requires_grad_()
        identity = torch.eye(len(known), dtype=torch.float64)
        optimizer = torch.optim.Adam([logarithms], lr=_RATE)
        for _ in range(_STEPS):
            optimizer.zero_grad()
            scales, ridge = logarithms[:-1].exp(), logarithms[-1].exp().clamp(min=_LEAST_RIDGE)
            inverse = torch.linalg.inv(_kernel(known * scales, known * scales) + ridge * identity)
            left_out = (inverse @ wanted) / inverse.diagonal()[:, None]
            loss = (left_out.square().mean(1) + 1e-9).sqrt().mean() + _FEWER_INPUTS * scales.sum()
            loss.backward()
            optimizer.step()
        learned = logarithms.detach().exp()
    return learned[:-1], learned[-1].clamp(min=_LEAST_RIDGE)
