"""One performer's pattern warped to another's: a dense flow between their neutral images, used for every frame."""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.rendering.gaussian_blur import gaussian_blur

Method = Literal["dis", "farneback"]

_SOFTENING = 1.0  # pixels, standard deviation


def neutral_flow(own: Tensor, reference: Tensor, method: Method = "dis") -> Tensor:
    r"""The flow from each pixel of the reference's neutral pattern to the same spot of one's own.

    .. math:: \text{own}(x + u(x)) \approx \text{reference}(x)

    Found once a performer, at rest, and used for every frame: a flow a frame would remove the expression.

    Args:
        own, reference: neutral patterns, (R,h,w) in [0,1].
        method: OpenCV's dense flow: DIS, or Farnebäck's polynomials, which lose fine dashes more easily.

    Returns:
        u, (R,h,w,2), pixels of the region, x first.

    Raises:
        ShapeError: the patterns differ in shape.

    Source: Farnebäck 2003; Kroeger et al. 2016; thesis 4.1.12.
    """
    if own.shape != reference.shape or own.ndim != 3:
        raise ShapeError(f"patterns: found {tuple(own.shape)} and {tuple(reference.shape)}, expected (R,h,w) twice")
    flows = [_flow(a, b, method) for a, b in zip(_grey(reference), _grey(own), strict=True)]
    return torch.stack(flows)


def aligned_grid(grid: Tensor, flow: Tensor) -> Tensor:
    """The sampling grid of the regions moved by a flow in region pixels; both (R,h,w,2)."""
    step = torch.stack([grid[:, 0, 1, 0] - grid[:, 0, 0, 0], grid[:, 1, 0, 1] - grid[:, 0, 0, 1]], dim=-1)
    return grid + flow * step[:, None, None]


def _grey(patterns: Tensor) -> np.ndarray:
    """Softened 8-bit images: what is thresholded has edges that a flow cannot follow."""
    soft = gaussian_blur(patterns[:, None], _SOFTENING)[:, 0]
    return (255 * soft.clamp(0, 1)).round().byte().numpy()


def _flow(start: np.ndarray, end: np.ndarray, method: Method) -> Tensor:
    import cv2

    still = np.zeros((*start.shape, 2), dtype=np.float32)
    if method == "dis":
        solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        solver.setFinestScale(0)
        flow = solver.calc(start, end, still)
    else:
        flow = cv2.calcOpticalFlowFarneback(
            start, end, still, pyr_scale=0.5, levels=3, winsize=13, iterations=10, poly_n=7, poly_sigma=1.5, flags=256
        )
    return torch.from_numpy(np.ascontiguousarray(flow))
