"""Blendshape weights under edit: one pose, or a take whose frames are corrected by hand."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.shape_names import antagonists, mirror
from torchface.take import Take, Track

_FPS = 60.0
_ACTIVE = 0.01


class WeightEditor:
    r"""Weights (T,N) and the frame in view.

    An edit moves the frame in view to the value asked for and takes its neighbours along, so that a correction does
    not stand out as a jump; with spread :math:`s`, frame :math:`t + k` moves by

    .. math:: \Delta_k = \tfrac12 \left(1 + \cos \tfrac{\pi k}{s+1}\right) \Delta_0, \quad |k| \le s

    Args:
        spread: frames on each side that an edit takes along.
        symmetric: an edit of a left shape sets its right twin too, and the other way round; ``jawLeft`` has none.
    """

    def __init__(
        self, names: Sequence[str], weights: Tensor | None = None, spread: int = 0, symmetric: bool = False
    ) -> None:
        start = torch.zeros(1, len(names)) if weights is None else weights.detach().to("cpu", torch.float32)
        if start.ndim != 2 or start.shape[1] != len(names) or len(start) == 0:
            raise ShapeError(f"weights: found {tuple(start.shape)}, expected (T,{len(names)}) with at least one frame")
        if not torch.isfinite(start).all():
            raise ValueRangeError(
                f"weights: {int((~torch.isfinite(start)).sum())} are NaN or infinite; expected numbers to show"
            )
        self.names = tuple(names)
        self.weights = start.clone()
        self.spread = spread
        self.symmetric = symmetric
        self.low = start.amin(0).clamp(max=0.0)
        self.high = start.amax(0).clamp(min=1.0)
        self._loaded = start.clone()
        opposed = antagonists(names).sort(1).values.tolist()
        twins = enumerate(mirror(names).tolist())
        self._twins = [row if sorted([row, twin]) in opposed else twin for row, twin in twins]
        self._frame = 0

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def frame(self) -> int:
        """The frame in view; what is set outside the take is clamped to its ends."""
        return self._frame

    @frame.setter
    def frame(self, frame: int) -> None:
        self._frame = min(max(int(frame), 0), len(self) - 1)

    @property
    def pose(self) -> Tensor:
        """Weights (N,) of the frame in view."""
        return self.weights[self._frame]

    def set(self, name: str, value: float) -> tuple[str, ...]:
        """Moves one shape, or with ``symmetric`` both twins, in the frame in view; returns the names that were set."""
        if name not in self.names:
            raise NameMismatchError(f"weights: found {name!r}, expected a shape of the rig: {self.names[0]}, ...")
        if not abs(value) < float("inf"):
            raise ValueRangeError(f"weights: found {value} for {name}, expected a number")
        row = self.names.index(name)
        rows = sorted({row, self._twins[row]}) if self.symmetric else [row]
        target = self.pose.clone()
        target[rows] = value
        self._move(target)
        return tuple(self.names[i] for i in rows)

    def rest(self) -> None:
        """Sets every shape of the frame in view to zero."""
        self._move(torch.zeros_like(self.pose))

    def reset_frame(self) -> None:
        """Gives the frame in view, and by ``spread`` its neighbours, back what was loaded."""
        frames, window = self._window()
        self.weights[frames] += window * (self._loaded[frames] - self.weights[frames])

    def reset(self) -> None:
        """Gives every frame back what was loaded."""
        self.weights.copy_(self._loaded)

    def active(self) -> list[tuple[str, float]]:
        """Shapes of the frame in view whose weight is at least 0.01 in size, largest first."""
        pose = self.pose
        order = pose.abs().argsort(descending=True, stable=True).tolist()
        return [(self.names[i], float(pose[i])) for i in order if abs(float(pose[i])) >= _ACTIVE]

    def to_take(self, source: Take | None = None) -> Take:
        """The weights as a take, with rate, timecode and extras of the take that they came from."""
        track = Track(self.names, self.weights[..., None].clone())
        if source is None:
            return Take(_FPS, weights=track)
        return replace(source, markers=None, landmarks=None, weights=track)

    def _window(self) -> tuple[slice, Tensor]:
        first, last = max(self._frame - self.spread, 0), min(self._frame + self.spread, len(self) - 1)
        distance = torch.arange(first, last + 1) - self._frame
        window = 0.5 * (1 + torch.cos(torch.pi * distance / (self.spread + 1)))
        return slice(first, last + 1), window[:, None]

    def _move(self, target: Tensor) -> None:
        frames, window = self._window()
        change = target - self.pose
        moved = self.weights[frames] + window * change
        # Neighbours stay within the sliders; a shape that is not edited keeps its exact bits.
        moved = torch.where(change == 0, self.weights[frames], moved.clamp(self.low, self.high))
        self.weights[frames] = moved
        self.weights[self._frame] = target
