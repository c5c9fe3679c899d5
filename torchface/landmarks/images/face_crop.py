"""The upright square that a network is shown of a face, and the way between its pixels and the image's."""

import math

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.images.boxes.face_box import check_image, interleaved

CROP_MARGIN = 1.25  # a crop's side in sides of the face's box, where nothing else is said

_MAX_SIDE = 1e5


def crop_transform(box: Tensor, tilt: float, size: int, margin: float = CROP_MARGIN) -> Tensor:
    r"""What takes an image's pixels to a crop's: :math:`\tfrac{n}{m w} R_{-\theta} (x - c) + \tfrac{n-1}{2}`.

    Args:
        box: x, y, width, height of the face, (4,) pixels; one that is no square counts as the square of the same middle
            and area.
        tilt: :math:`\theta`, radians, clockwise as the image is seen; the crop shows the face upright.
        margin: m, the crop's side in sides of the box.

    Returns:
        (2,3) float64, pixel centres at integers in both.
    """
    if box.shape != (4,):
        raise ShapeError(f"box: found {tuple(box.shape)}, expected (4,)")
    side = math.sqrt(max(float(box[2] * box[3]), 0.0)) if bool(torch.isfinite(box).all()) else 0.0
    if not (1 <= side <= _MAX_SIDE and math.isfinite(tilt)):
        raise ValueRangeError(
            f"box: found {box.tolist()}, tilt {tilt:g}; expected a face of 1 to {_MAX_SIDE:g} pixels, and an angle"
        )
    middle = (box[:2] + box[2:] / 2).double()
    scale = size / (margin * side)
    cos, sin = scale * math.cos(tilt), scale * math.sin(tilt)
    turn = torch.tensor([[cos, sin], [-sin, cos]], dtype=torch.float64)
    return torch.cat([turn, ((size - 1) / 2 - turn @ middle)[:, None]], 1)


def cut_crop(image: Tensor, transform: Tensor, size: int) -> Tensor:
    """The square uint8 (3,S,S) of an image that a transform shows; beyond the border the border's pixels go on.

    Where the face is larger than the crop it is made smaller by averaging first, so that no pixels are skipped.

    A grey image (H,W) gives three planes alike; others are (3,H,W) red first.
    """
    return cut_crops(image, transform[None], size, size)[0]


def cut_crops(image: Tensor, transforms: Tensor, width: int, height: int) -> Tensor:
    """Rectangles uint8 (N,3,h,w) of one image, near each other and of one scale; see :func:`cut_crop`."""
    check_image(image)
    rows, columns = image.shape[-2:]
    ways, last, low = transforms.double().numpy(), width - 0.5, height - 0.5  # NumPy is quicker on few numbers
    corners = np.array([[-0.5, -0.5], [last, -0.5], [-0.5, low], [last, low]])
    seen = (corners - ways[:, None, :, 2]) @ np.linalg.inv(ways[:, :, :2]).transpose(0, 2, 1)
    seen = seen.astype(np.float32).reshape(-1, 2)
    left, top = np.maximum(np.floor(seen.min(0) - 2), 0).astype(int).tolist()
    right, bottom = (np.ceil(seen.max(0) + 2).astype(int) + 1).tolist()
    left, top = min(left, columns - 1), min(top, rows - 1)
    right, bottom = min(max(right, left + 1), columns), min(max(bottom, top + 1), rows)
    # Whole pixels are averaged, which OpenCV does ten times as fast as shares of them; the rest is left to the warp.
    (a, b, _), (c, d, _) = ways[0].tolist()
    step = max(1, round(1 / math.sqrt(abs(a * d - b * c))))
    high, wide = max(1, (bottom - top) // step) * step, max(1, (right - left) // step) * step
    pixels = interleaved(image[..., top : top + high, left : left + wide])
    high, wide = pixels.shape[:2]
    small = (max(1, wide // step), max(1, high // step))
    if step > 1:
        pixels = cv2.resize(pixels, small, interpolation=cv2.INTER_AREA)
    if image.ndim == 2:
        pixels = cv2.merge([pixels] * 3)
    ratio = (small[0] / wide, small[1] / high)
    # From the pixels of the piece, that may be a smaller copy, to the image's, and from there to the crop's.
    back = np.array([[1 / ratio[0], 0, left - 0.5 + 0.5 / ratio[0]], [0, 1 / ratio[1], top - 0.5 + 0.5 / ratio[1]]])
    back = np.concatenate([back, [[0.0, 0.0, 1.0]]])
    crops = [
        cv2.warpAffine(pixels, way @ back, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for way in ways
    ]
    return torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2)


def from_crop(points: Tensor, transform: Tensor) -> Tensor:
    """Points (...,2) of a crop as points of the image, float32."""
    return ((points.double() - transform[:, 2]) @ torch.linalg.inv(transform[:, :2]).T).float()
