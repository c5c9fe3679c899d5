"""Keyframes between which a motion is timed: where it turns and where it holds."""

import torch
from torch import Tensor

_HOLD = 0.08  # of a motion's highest speed: what is slower at either end is a hold
_SMOOTHING = 1 / 30  # s, standard deviation: quicker changes of speed are noise


def find_keyframes(path: Tensor, tolerance: float) -> list[int]:
    """The frames at which a motion (T,D) turns, the first and the last among them, rising.

    The path is simplified as a line: it is cut where it leaves the straight way between two keyframes furthest, until
    it nowhere leaves it by more than a share of the animation's range.

    Source: Douglas and Peucker 1973.
    """
    if len(path) < 3:
        return list(range(len(path)))
    limit = tolerance * float((path.amax(0) - path.amin(0)).norm())
    keys, open_pieces = [0, len(path) - 1], [(0, len(path) - 1)]
    # Each cut depends on the one before.
    while open_pieces:
        first, last = open_pieces.pop()
        if last - first < 2:
            continue
        way = path[last] - path[first]
        offset = path[first + 1 : last] - path[first]
        share = (offset @ way / way.square().sum().clamp(min=1e-30)).clamp(0, 1)
        distance = (offset - share[:, None] * way).norm(dim=1)
        worst = int(distance.argmax())
        if float(distance[worst]) > limit:
            cut = first + 1 + worst
            keys.append(cut)
            open_pieces += [(first, cut), (cut, last)]
    return sorted(keys)


def travelled(path: Tensor) -> Tensor:
    """The share of its way that a motion (T,D) has gone in each frame, (T,), 0 first and 1 last; 0 where it rests."""
    lengths = (path[1:] - path[:-1]).norm(dim=1)
    way = lengths.new_zeros(len(path))
    way[1:] = lengths.cumsum(0)
    return way / way[-1].clamp(min=1e-30)


def without_holds(path: Tensor, fps: float) -> tuple[int, int]:
    """The first and the last frame of a motion (T,D) without the holds at its ends; the same where it rests."""
    if len(path) < 2:
        return 0, 0
    frames = torch.arange(len(path), dtype=path.dtype)
    weights = torch.exp(-0.5 * ((frames[:, None] - frames) / (_SMOOTHING * fps)) ** 2)
    smooth = (weights / weights.sum(1, keepdim=True)) @ path
    speed = torch.cat([smooth[1:2] - smooth[:1], (smooth[2:] - smooth[:-2]) / 2, smooth[-1:] - smooth[-2:-1]]).norm(
        dim=1
    )
    if not float(speed.max()) > 0:
        return 0, 0
    moving = (speed > _HOLD * speed.max()).nonzero()[:, 0]
    return max(int(moving[0]) - 1, 0), min(int(moving[-1]) + 1, len(path) - 1)
