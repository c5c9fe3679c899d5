"""Curves smoothed along time."""

from __future__ import annotations

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError


def savitzky_golay(values: Tensor, window: int, order: int = 2) -> Tensor:
    r"""The value that a polynomial, fitted to the frames around, has at each frame.

    .. math:: y_t = p_t(0), \qquad p_t = \arg\min_{\deg p \le d} \sum_{|s| \le h} (x_{t+s} - p(s))^2

    At the ends, where frames lack on one side, the polynomial of the first or last whole window is read off. An even
    window counts as the next odd one; a take shorter than the window is one window.

    Args:
        values: x, (T,...), frames first.
        window: how many frames, 2h+1.
        order: degree d, less than the window.

    Returns:
        Smoothed values, (T,...); they may leave the range of the values by a little.

    Raises:
        ShapeError: there is no frame.
        ValueRangeError: a window that is not positive, or an order that it cannot hold.

    Source: Savitzky and Golay 1964; thesis 4.1.8 and 4.1.12.
    """
    frames = len(values)
    if values.ndim == 0 or frames == 0:
        raise ShapeError(f"savitzky_golay: found values {tuple(values.shape)}, expected (T,...) with a frame at least")
    if window < 1 or not 0 <= order < window:
        raise ValueRangeError(f"savitzky_golay: found window {window} and order {order}, expected 0 <= order < window")
    window = min(window | 1, frames if frames % 2 else frames - 1) if frames > 1 else 1
    order = min(order, window - 1)
    if window == 1:
        return values.clone()
    half = window // 2
    place = torch.linspace(-1, 1, window, dtype=torch.float64, device=values.device)
    powers = place[:, None] ** torch.arange(order + 1, device=values.device)
    # Row s of the hat matrix reads the fitted polynomial off at frame s of the window.
    hat = (powers @ torch.linalg.pinv(powers)).to(values)
    curves = values.flatten(1) if values.ndim > 1 else values[:, None]
    middle = torch.einsum("tcw,w->tc", curves.unfold(0, window, 1), hat[half])
    smooth = torch.cat([hat[:half] @ curves[:window], middle, hat[half + 1 :] @ curves[-window:]])
    return smooth.reshape(values.shape)
