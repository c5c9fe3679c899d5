"""Curves smoothed along time."""

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import as_real


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

    Example:
        >>> squares = torch.arange(7.0) ** 2
        >>> torch.allclose(savitzky_golay(squares, window=5), squares, atol=1e-4)
        True
    """
    values = as_real(values)
    frames = len(values) if values.ndim else 0
    if frames == 0:
        raise ShapeError(f"savitzky_golay: found values {tuple(values.shape)}, expected (T,...) with a frame at least")
    if window < 1 or not 0 <= order < window:
        raise ValueRangeError(f"savitzky_golay: found window {window} and order {order}, expected 0 <= order < window")
    window = min(window | 1, frames if frames % 2 else frames - 1) if frames > 1 else 1
    order = min(order, window - 1)
    if window == 1:
        return values.clone()
    half, flat = window // 2, values.detach().reshape(frames, -1).double()
    powers = torch.arange(order + 1, device=flat.device)
    at = torch.linspace(-1, 1, window, dtype=torch.float64, device=flat.device)[:, None] ** powers
    fitted = at @ torch.linalg.pinv(at)  # a window's values to those of the polynomial through them
    middle = flat.unfold(0, window, 1) @ fitted[half]
    smooth = torch.cat([fitted[:half] @ flat[:window], middle, fitted[half + 1 :] @ flat[-window:]])
    return smooth.reshape(values.shape).to(values)
