"""Cuts in films: whether the next frame shows another picture.

Tensor operations alone: they go into graphs.
"""

import torch
from torch import Tensor

from torchface.landmarks.images.person_identity import face_look

PARTS = 16
"""Parts a side of a picture that are compared each."""

_SAMPLES = 4  # rows or columns of a part that are looked at
# A cut changes a picture so much, 1 less its correlation, and so many times as much as the frame before did: who passes
# close to the camera takes some frames. It changes by so many grey levels so large a share of the picture: of 536 pairs
# of pictures of films 508 by more, of 98 frames in which people pass, 10 a second, none.
_CUT, _SUDDEN, _LEVELS, _SHARE = 0.25, 4.0, 5.0, 0.7


def small_copy(image: Tensor) -> Tensor:
    """A small copy (3,PARTS,PARTS) of a picture (H,W,C), 3 channels or 4."""
    count = PARTS * _SAMPLES
    places = torch.arange(count, device=image.device) + 0.5
    for axis in (0, 1):  # rows first: most pixels are gone when the columns' turn comes
        size = torch.full((), image.shape[axis], dtype=torch.float32, device=image.device)
        image = image.index_select(axis, (places * (size / count)).long())
    parts = image[..., :3].float().view(PARTS, _SAMPLES, PARTS, _SAMPLES, 3)
    return parts.mean((1, 3)).permute(2, 0, 1)


def cut_between(before: Tensor, after: Tensor, change: Tensor) -> tuple[Tensor, Tensor]:
    """Whether a cut lies between two pictures, small copies of one size, () bool, and by how much they differ, ();
    ``change`` is by how much the earlier one differed from that before it."""
    sudden, now = sudden_change(before, after, change)
    share = ((after - before).square().mean(0).sqrt() > _LEVELS).float().mean()
    return sudden & (share > _SHARE), now


def sudden_change(before: Tensor, after: Tensor, change: Tensor) -> tuple[Tensor, Tensor]:
    """As :func:`cut_between`, where a plain background may stay as it is."""
    now = 1 - face_look(after) @ face_look(before)
    return now > (_SUDDEN * change).clamp(min=_CUT), now
