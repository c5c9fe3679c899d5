"""Lens distortion: from an ideal pinhole camera's pixels to a real one's, and back."""

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.geometry.cameras.calibration import CameraCalibration

_MAX_ITERATIONS, _DONE = 20, 1e-13


def distort(pixels: Tensor, calibration: CameraCalibration) -> Tensor:
    r"""Where (...,2) the camera shows what a pinhole camera of the same K shows at some pixels (...,2); NaN stays NaN.

    .. math::
        x' = x (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + 2 p_1 x y + p_2 (r^2 + 2 x^2), \qquad
        y' = y (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + p_1 (r^2 + 2 y^2) + 2 p_2 x y

    with :math:`(x, y, 1) \propto K^{-1} q` and :math:`r^2 = x^2 + y^2`; differentiable.

    Source: Brown 1966, as in OpenCV; thesis 4.2.4.
    """
    K, coefficients = _parts(pixels, calibration)
    bent, _ = _bent(_normalised(pixels, K), coefficients)
    return _in_pixels(bent, K)


def undistort(pixels: Tensor, calibration: CameraCalibration) -> Tensor:
    """Where a pinhole camera of the same K shows what the camera shows at some pixels: ``distort`` inverted.

    By Newton's method from the distorted place, in float64.

    Args:
        pixels: in the camera's images, (...,2); NaN stays NaN.

    Returns:
        Pixels of the pinhole camera, (...,2); NaN so far outside of the calibrated image that the model folds back
        and nothing is seen there.

    Source: thesis 4.2.4.
    """
    K, coefficients = _parts(pixels, calibration)
    if not coefficients.any():
        return pixels.clone()
    goal = _normalised(pixels.double(), K.double())
    coefficients = coefficients.double()
    place = goal
    for _ in range(_MAX_ITERATIONS):  # Newton's steps, all points at once; seen points need three or four
        bent, jacobian = _bent(place, coefficients)
        (a, b), (c, d) = jacobian[..., 0, :].unbind(-1), jacobian[..., 1, :].unbind(-1)
        miss = bent - goal
        determinant = a * d - b * c
        step = torch.stack([d * miss[..., 0] - b * miss[..., 1], a * miss[..., 1] - c * miss[..., 0]], dim=-1)
        step = step / determinant[..., None]
        # Never further than a quarter of where the point is: full steps from afar jump over the fold.
        longest = 0.25 * (place.norm(dim=-1) + 0.1)
        place = place - step * (longest / step.norm(dim=-1).clamp(min=1e-30)).clamp(max=1.0)[..., None]
        if not (step.nan_to_num(0.0).abs() > _DONE).any():
            break
    bent, jacobian = _bent(place, coefficients)
    # Beyond the fold the image is folded over; there, and where no step led to the goal, nothing is seen.
    upright = (jacobian.det() > 0) & (jacobian.diagonal(dim1=-2, dim2=-1).sum(-1) > 0)
    reached = ((bent - goal).abs().amax(-1) < 1e-9) & upright
    return _in_pixels(torch.where(reached[..., None], place, torch.nan), K.double()).to(pixels.dtype)


def undistort_image(image: Tensor, calibration: CameraCalibration) -> Tensor:
    """What a camera without distortion would have seen, uint8 (3,H,W)."""
    if not calibration.distortion.any():
        return image
    import cv2  # loads in 0.1 s

    bent = np.ascontiguousarray(image.permute(1, 2, 0).numpy())
    straight = cv2.undistort(bent, calibration.intrinsics.numpy(), calibration.distortion.numpy())
    return torch.from_numpy(straight).permute(2, 0, 1)


def _parts(pixels: Tensor, calibration: CameraCalibration) -> tuple[Tensor, Tensor]:
    if pixels.ndim == 0 or pixels.shape[-1] != 2:
        raise ShapeError(f"pixels: found {tuple(pixels.shape)}, expected (...,2)")
    return calibration.intrinsics.to(pixels), calibration.distortion.to(pixels)


def _normalised(pixels: Tensor, K: Tensor) -> Tensor:
    y = (pixels[..., 1] - K[1, 2]) / K[1, 1]
    return torch.stack([(pixels[..., 0] - K[0, 2] - K[0, 1] * y) / K[0, 0], y], dim=-1)


def _in_pixels(places: Tensor, K: Tensor) -> Tensor:
    return places @ K[:2, :2].T + K[:2, 2]


def _bent(places: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Distorted places (...,2) at depth 1, and what moves them: (...,2,2)."""
    k1, k2, p1, p2, k3 = coefficients.unbind()
    x, y = places.unbind(-1)
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    slope = 2 * (k1 + square * (2 * k2 + square * 3 * k3))  # of the radial factor, over x or y
    bent = torch.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ],
        dim=-1,
    )
    across = x * y * slope + 2 * p1 * x + 2 * p2 * y
    rows = [
        torch.stack([radial + x * x * slope + 2 * p1 * y + 6 * p2 * x, across], dim=-1),
        torch.stack([across, radial + y * y * slope + 6 * p1 * y + 2 * p2 * x], dim=-1),
    ]
    return bent, torch.stack(rows, dim=-2)
