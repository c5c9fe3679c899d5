"""The actor's timing of motions between keyframes, by region: learned where the database has motions enough."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.enhancement.learned_timing import LearnedTiming
from torchface.enhancement.retiming import captured_sequences, check_keyframes, moving_regions, nearest_timing
from torchface.number_checks import checked_count, checked_number


class ActorTiming:
    """How the captured actor moves between two poses.

    A region of enough captured motions has a regression of its own, see
    :class:`~torchface.enhancement.learned_timing.LearnedTiming`; any other takes the mean of its nearest motions, see
    :func:`~torchface.enhancement.retiming.nearest_timing`; one at rest follows the whole face.

    Args:
        database: features of the captured frames, (K,P,C).
        sequences: the number of each captured frame's sequence, (K,).
        weights: of patches in each region, (R,P).
        fps: of the captured frames.

    Raises:
        ShapeError: the shapes do not fit.
        ValueRangeError: no sequence has two frames.
    """

    def __init__(self, database: Tensor, sequences: Tensor, weights: Tensor, fps: float) -> None:
        self._owned = captured_sequences(database, sequences)
        self._weights = weights
        self._whole = weights.mean(0)
        self._learned = [LearnedTiming.fit(database, sequences, region, fps) for region in (*weights, self._whole)]

    def times(self, keyframes: Tensor, frames: int, length: float) -> Tensor:
        """How far the motion between two keyframes has come in each frame, (R,frames), 0 first, 1 last, never falling.

        Args:
            keyframes: features of both, (2,P,C).
            frames: at even distance, both keyframes counted.
            length: of the motion, in frames of the database.

        Raises:
            ShapeError: features of other patches.
            ValueRangeError: the keyframes are equal, or fewer than two frames.
        """
        checked_count("frames", frames, 2)
        checked_number("length", length, above=True)
        check_keyframes(keyframes, self._owned[0].shape[1:])
        moves = moving_regions(keyframes, self._weights)
        whole = self._region(-1, self._whole, keyframes, frames, length)
        rows = [
            self._region(row, region, keyframes, frames, length) if moves[row] else whole
            for row, region in enumerate(self._weights)  # each has a regression of its own
        ]
        return torch.stack(rows)

    def _region(self, row: int, region: Tensor, keyframes: Tensor, frames: int, length: float) -> Tensor:
        learned = self._learned[row]
        if learned is not None:
            return learned.times(keyframes, frames, length)
        return nearest_timing(keyframes, self._owned, region, frames, length)
