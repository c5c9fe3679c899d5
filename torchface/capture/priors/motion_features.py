"""Features of a window of weights: its place, slope and curvature."""

import re
from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import as_real

_REGIONS = (r"eye_?look|pupil", r"eye", r"brow", r"cheek|nose", r"")
_MAX_ORDERS = 3
_SAME_RATE = 0.02  # relative


def face_regions(names: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """The shapes that move together: gaze, lids, brows, cheeks with nose, and all others (jaw, lips, tongue).

    Returns:
        Rows of ``names``, a tuple a region; every shape in one of them; regions without shapes are left out.

    Example:
        >>> face_regions(["jawOpen", "eyeBlink_L", "eyeLookIn_L", "browInnerUp", "mouthPucker"])
        ((2,), (1,), (3,), (0, 4))
    """
    region_of = [next(i for i, kind in enumerate(_REGIONS) if re.match(kind, name, re.IGNORECASE)) for name in names]
    regions = (tuple(row for row, region in enumerate(region_of) if region == i) for i in range(len(_REGIONS)))
    return tuple(region for region in regions if region)


def motion_basis(window: int) -> Tensor:
    """Discrete orthonormal polynomials over a window's J frames: place, slope and curvature, (J,O), float64, O at most
    3.

    White noise of the frames is white, and of the same size, in all of them.
    """
    # On the CPU also where a model is being rebuilt without memory: it is computed, not loaded.
    steps = torch.linspace(-1, 1, window, dtype=torch.float64, device="cpu")
    powers = torch.stack([steps**order for order in range(min(window, _MAX_ORDERS))], dim=1)
    basis, triangle = torch.linalg.qr(powers)
    return basis * triangle.diagonal().sign()


def moving_parts(windows: Tensor, motion: Tensor) -> Tensor:
    """The motion in windows (B,J,N), or ``motion`` along the columns of :func:`motion_basis`, (B,O,N): slope,
    curvature, and the last step by itself, which has no lag; (B,K,N). K is 3, 2 for a window of two frames, 0 for a
    window of one."""
    if windows.shape[1] < 2:
        return motion[:, 1:]
    return torch.cat([motion[:, 1:], windows[:, -1:] - windows[:, -2:-1]], dim=1)


def newest_frames(windows: Tensor, window: int, shapes: int) -> Tensor:
    """The last ``window`` frames (B,J,N) of windows (B,J',N)."""
    windows = as_real(windows, "windows")
    if windows.ndim != 3 or windows.shape[1] < window or windows.shape[2] != shapes:
        raise ShapeError(f"windows: found {tuple(windows.shape)}, expected (B,{window},{shapes}) or more frames")
    return windows[:, -window:]


def windows_of(weights: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """Every window of a take, and the frame that follows it.

    Args:
        weights: (T,N); windows that meet a NaN are left out.
        window: J.

    Returns:
        (B,J,N) and (B,N).

    Raises:
        ShapeError: the take is too short for a single window with a frame after it.
        ValueRangeError: no window is free of NaN.

    Example:
        >>> windows, following = windows_of(torch.arange(4.0)[:, None], window=2)
        >>> windows[..., 0].tolist(), following[:, 0].tolist()
        ([[0.0, 1.0], [1.0, 2.0]], [2.0, 3.0])
    """
    if weights.ndim != 2 or len(weights) <= window:
        raise ShapeError(
            f"take: found {tuple(weights.shape)}, expected (T,N) with at least {window + 1} frames for a window of "
            f"{window} and the frame after it"
        )
    frames = weights.unfold(0, window + 1, 1).transpose(1, 2)
    frames = frames[torch.isfinite(frames).flatten(1).all(1)]
    if not len(frames):
        raise ValueRangeError(f"take: found NaN in every window of {window + 1} frames, expected some without")
    return frames[:, :window], frames[:, window]


def same_rate(fps: float, other: float) -> bool:
    """Whether two frame rates count as the same: 59.94 and 60 frames a second do, 25 and 24 do not."""
    return abs(fps - other) <= _SAME_RATE * fps
