"""State of a face that a tracker follows: its place, the finder's box beside it, its look, and counts."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.landmarks.images.face_crop import crop_transform, cut_crop
from torchface.landmarks.images.ibug_68 import turned_box
from torchface.landmarks.images.person_identity import IDENTITY, LOOK_MARGIN, face_look

_SIZE = 20  # pixels of the crop that a look is read from
_LOOK = 3 * _SIZE * _SIZE
_NEAR, _SMALLER, _LARGER = 0.75, 0.6, 1.6  # sides of the box, and factors of its size

LOOK = _LOOK  # numbers of a look
MEMORY = 5 + 3 + IDENTITY + 4  # numbers that a followed face is packed into


@dataclass(eq=False)
class FollowedFace:
    """What is known of one face; absent for unknown."""

    place: Tensor | None = None  # its upright box and its tilt, (5,)
    # Where the finder's box lies as the face sees it: its middle from the upright box's (2,) in sides of that, and its
    # size by that's; (3,).
    anchor: Tensor | None = None
    # What is known of it and of somebody who passes before it; see
    # :mod:`~torchface.landmarks.images.person_identity`.
    people: Tensor = field(default_factory=lambda: torch.zeros(IDENTITY))
    missed: int = 0  # frames in a row without it
    frames: int = 0
    unconfirmed: int = 0  # checks in a row in which the detector saw no face at its place
    covered: bool = False  # whether a landmark was hidden in the last frame
    # Its colours in the last frame that showed it, upright and small, (1200,) of unit length; not packed.
    latest_look: Tensor | None = None

    def pack(self) -> Tensor:
        """All of it as a tensor (218,) float64; NaN for unknown."""
        parts = (self.place, 5), (self.anchor, 3), (self.people, IDENTITY)
        known = [torch.full((size,), torch.nan) if part is None else part.cpu() for part, size in parts]
        counts = [self.missed, self.frames, self.unconfirmed, self.covered]
        return torch.cat([*(part.double() for part in known), torch.tensor(counts, dtype=torch.float64)])

    @classmethod
    def unpack(cls, packed: Tensor) -> "FollowedFace":
        """What :meth:`pack` packed."""
        if packed.shape != (MEMORY,):
            raise ShapeError(f"resume: found a memory of {tuple(packed.shape)}, expected ({MEMORY},)")
        *parts, people, counts = packed.float().split([5, 3, IDENTITY, 4])
        place, anchor = (part if bool(torch.isfinite(part).all()) else None for part in parts)
        missed, frames, unconfirmed, covered = (int(count) for count in counts.nan_to_num(0.0))
        return cls(place, anchor, people.nan_to_num(0.0), missed, frames, unconfirmed, covered > 0)

    def set_anchor(self, box: Tensor) -> None:
        """Notes where the box (4,) lies that the face, whose place is known, was found in."""
        place = self.place
        assert place is not None
        offset = (box[:2] + box[2:] / 2 - place[:2] - place[2:4] / 2) / place[2]
        relation = (_rotation(place[4]).T @ offset).clamp(-0.3, 0.3)
        self.anchor = torch.cat([relation, (box[2:3] / place[2:3]).clamp(0.7, 1.4)])

    def anchored_box(self, box: Tensor, tilt: Tensor) -> Tensor:
        """The finder's box (4,) for a face with this upright box (4,) and tilt."""
        anchor = self.anchor
        if anchor is None:
            return box
        side = box[2] * anchor[2]
        middle = box[:2] + box[2:] / 2 + box[2] * (_rotation(tilt) @ anchor[:2])
        return torch.cat([middle - side / 2, side.expand(2)])

    def near(self, boxes: Tensor) -> list[int]:
        """Which of boxes (F,4) lie about where the face was last, and are about of its size, the nearest first."""
        if self.place is None or not len(boxes):
            return []
        middle = boxes[:, :2] + boxes[:, 2:] / 2
        distance = (middle - self.place[:2] - self.place[2:4] / 2).norm(dim=1) / self.place[2]
        ratio = boxes[:, 2] / self.place[2]
        near = (distance < _NEAR) & (ratio > _SMALLER) & (ratio < _LARGER)
        return [i for i in distance.argsort(stable=True).tolist() if near[i]]


def look_at(image: Tensor, place: Tensor, size: int = _SIZE) -> Tensor:
    """The look of a face at an upright box and its tilt (5,) in an image, from a square of so many pixels a side; see
    :func:`~torchface.landmarks.images.person_identity.face_look`."""
    return face_look(cut_crop(image, crop_transform(place[:4], float(place[4]), size, LOOK_MARGIN), size).float())


def face_place(landmarks: Tensor) -> Tensor:
    """A face's upright box and its tilt, (5,), of landmarks (68,2)."""
    box, tilt = turned_box(landmarks)
    return torch.cat([box, tilt[None]])


def _rotation(tilt: Tensor) -> Tensor:
    """The rotation (2,2) of a face with a tilt, clockwise as the image is seen."""
    cos, sin = tilt.cos(), tilt.sin()
    return torch.stack([cos, -sin, sin, cos]).view(2, 2)
