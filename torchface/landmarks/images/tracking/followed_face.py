"""State of a face that a tracker follows: its place, the finder's box beside it, its look, and counts."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.landmarks.images.face_crop import crop_transform, cut_crop
from torchface.landmarks.images.ibug_68 import turned_box

_SIZE, _MARGIN = 20, 1.1  # pixels of the crop that a look is read from, and its side in sides of the box
_LOOK = 3 * _SIZE * _SIZE
_LEARNED = 0.1  # of how a face looks now that is taken up by what is known of its look
_NEAR, _SMALLER, _LARGER = 0.75, 0.6, 1.6  # sides of the box, and factors of its size

LOOK = _LOOK  # numbers of a look
MEMORY = 5 + 3 + _LOOK + 4  # numbers that a followed face is packed into


@dataclass(eq=False)
class FollowedFace:
    """What is known of one face; absent for unknown."""

    place: Tensor | None = None  # its upright box and its tilt, (5,)
    # Where the finder's box lies as the face sees it: its middle from the upright box's (2,) in sides of that, and its
    # size by that's; (3,).
    anchor: Tensor | None = None
    look: Tensor | None = None  # its colours, upright and small, (1200,) of unit length
    missed: int = 0  # frames in a row without it
    frames: int = 0
    unconfirmed: int = 0  # checks in a row in which the detector saw no face at its place
    crowded: bool = False  # whether somebody else is about who might be taken for it
    latest_look: Tensor | None = None  # the same in the last frame that showed it; not packed

    def pack(self) -> Tensor:
        """All of it as a tensor (1212,) float64; NaN for unknown."""
        parts = (self.place, 5), (self.anchor, 3), (self.look, _LOOK)
        known = [torch.full((size,), torch.nan) if part is None else part.cpu() for part, size in parts]
        counts = [self.missed, self.frames, self.unconfirmed, self.crowded]
        return torch.cat([*(part.double() for part in known), torch.tensor(counts, dtype=torch.float64)])

    @classmethod
    def unpack(cls, packed: Tensor) -> "FollowedFace":
        """What :meth:`pack` packed."""
        if packed.shape != (MEMORY,):
            raise ShapeError(f"resume: found a memory of {tuple(packed.shape)}, expected ({MEMORY},)")
        *parts, counts = packed.float().split([5, 3, _LOOK, 4])
        place, anchor, look = (part if bool(torch.isfinite(part).all()) else None for part in parts)
        missed, frames, unconfirmed, crowded = (int(count) for count in counts.nan_to_num(0.0))
        return cls(place, anchor, look, missed, frames, unconfirmed, crowded > 0)

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

    def likeness(self, image: Tensor, landmarks: Tensor) -> float:
        """How much a face looks like this one, the correlation of their colours; 1 where its look is not known."""
        return 1.0 if self.look is None else float(self.look @ face_look(image, face_place(landmarks)))

    def learn_look(self, image: Tensor, place: Tensor, least: float) -> None:
        """Takes up a share of how the face looks now, unless others are about and it looks less like itself."""
        look = self.latest_look = face_look(image, place)
        if self.look is None:
            self.look = look
        elif not self.crowded or float(self.look @ look) >= least:
            mixed = (1 - _LEARNED) * self.look + _LEARNED * look
            self.look = mixed / mixed.norm().clamp(min=1e-6)


def face_look(image: Tensor, place: Tensor) -> Tensor:
    """A face's colours, small and upright, about their mean, (1200,) of unit length: they distinguish people.

    The product of two is their correlation. The place (5,) is an upright box and its tilt.
    """
    crop = cut_crop(image, crop_transform(place[:4], float(place[4]), _SIZE, _MARGIN), _SIZE).float()
    # The mean of all colours goes, not that of each: how red a face is beside how blue differs between people.
    flat = (crop - crop.mean()).flatten()
    return flat / flat.norm().clamp(min=1e-6)


def face_place(landmarks: Tensor) -> Tensor:
    """A face's upright box and its tilt, (5,), of landmarks (68,2)."""
    box, tilt = turned_box(landmarks)
    return torch.cat([box, tilt[None]])


def _rotation(tilt: Tensor) -> Tensor:
    """The rotation (2,2) of a face with a tilt, clockwise as the image is seen."""
    cos, sin = tilt.cos(), tilt.sin()
    return torch.stack([cos, -sin, sin, cos]).view(2, 2)
