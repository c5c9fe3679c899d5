"""The upright rectangles that a network is shown of a face's eyes, and the way between their pixels and the image's."""

import torch
from torch import Tensor

from torchface.errors import ShapeError

CROP_WIDTH, CROP_HEIGHT = 48, 32  # pixels of an eye's crop

EYE_LANDMARKS = ((36, 37, 38, 39, 40, 41), (45, 44, 43, 42, 47, 46))
"""iBUG's landmarks of the right eye, and of the left in the order that the right one's have in a mirror: the outer
corner, two of the upper lid, the inner corner, two of the lower lid."""

SHARE = 0.83  # how wide a crop is, of the distance of the eyes
DOWN = 1.4  # the distance of the eyes over that of their middle from the nose's base, on heads seen from the front
NOSE_BASE = 33  # iBUG's landmark


def eye_transforms(landmarks: Tensor, width: int = CROP_WIDTH, height: int = CROP_HEIGHT) -> Tensor:
    r"""What takes an image's pixels to those of the crops of a face's two eyes, the left eye's mirrored.

    .. math:: \tfrac{n}{0.83\, s} M R (x - c) + \tfrac{1}{2}(n - 1, m - 1), \quad s^2 = \tfrac12 (a^2 + (1.4\, b)^2)

    with c the middle of the eye's corners, R the rotation that makes the face upright as eyes and mouth lie, M the
    mirror of the left eye; a is the distance of the eyes and b that of their middle from the nose's base, so that
    neither a turned nor a nodding head becomes large. Sums, products and roots alone: it goes into graphs as it is.

    Args:
        landmarks: iBUG's 68, (...,68,2) pixels of the image.
        width, height: n and m, pixels of the crops.

    Returns:
        (...,2,2,3), the person's right eye first; pixel centres at integers in both. NaN where landmarks are.
    """
    if landmarks.shape[-2:] != (68, 2):
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected (...,68,2)")
    corners = landmarks[..., [36, 39, 42, 45], :].unflatten(-2, (2, 2)).mean(-2)  # (...,2,2)
    middle = corners.mean(-2)
    across = corners[..., 1, :] - corners[..., 0, :]
    down = landmarks[..., 48:68, :].mean(-2) - middle
    # Both axes of the face, the second turned on the first: a head that turns aside shortens the first alone.
    upright = torch.stack([across[..., 0] + down[..., 1], across[..., 1] - down[..., 0]], -1)
    upright = upright / upright.square().sum(-1, keepdim=True).sqrt()
    nose = (landmarks[..., NOSE_BASE, :] - middle).square().sum(-1)
    size = ((across.square().sum(-1) + DOWN**2 * nose) / 2).sqrt()
    axis = upright * (width / (SHARE * size))[..., None]
    turn = torch.stack([axis, torch.stack([-axis[..., 1], axis[..., 0]], -1)], -2)  # (...,2,2)
    mirror = landmarks.new_tensor([[[1.0], [1.0]], [[-1.0], [1.0]]])
    turns = turn[..., None, :, :] * mirror
    shift = landmarks.new_tensor([(width - 1) / 2, (height - 1) / 2]) - (turns @ corners[..., None])[..., 0]
    return torch.cat([turns, shift[..., None]], -1)


def picture_transforms(transforms: Tensor) -> Tensor:
    """The way back: what takes pixels of crops to the image's, (...,2,3) of (...,2,3).

    Source: the inverse of a rotation with a scale, mirrored or not, is its transpose over the squared scale.
    """
    turn = transforms[..., :2]
    back = turn.transpose(-1, -2) / turn[..., 0, :].square().sum(-1)[..., None, None]
    return torch.cat([back, -back @ transforms[..., 2:]], -1)


def moved(points: Tensor, transforms: Tensor) -> Tensor:
    """Points (...,P,2) through affine maps (...,2,3)."""
    return points @ transforms[..., :2].transpose(-1, -2) + transforms[..., None, :, 2]
