"""State of a face that a tracker follows: its place, the finder's box beside it, its look, and counts."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.landmarks.images.face_crop import crop_transform, cut_crop
from torchface.landmarks.images.ibug_68 import turned_box
from torchface.landmarks.images.person_identity import IDENTITY, LOOK_MARGIN, face_look, look_alone
from torchface.landmarks.images.picture_cut import PARTS, small_copy, sudden_change

_SIZE = 20  # pixels of the crop that a look is read from
_LOOK = 3 * _SIZE * _SIZE
_UNCHANGED = 0.9  # correlation from which a part of a picture is as it was
_NEAR, _SMALLER, _LARGER = 0.75, 0.6, 1.6  # sides of the box, and factors of its size

LOOK = _LOOK  # numbers of a look
MEMORY = 5 + 3 + 2 * 3 * PARTS**2 + IDENTITY + 6  # numbers that a followed face is packed into


@dataclass(eq=False)
class FollowedFace:
    """What is known of one face; absent for unknown."""

    place: Tensor | None = None  # its upright box and its tilt, (5,)
    # Where the finder's box lies as the face sees it: its middle from the upright box's (2,) in sides of that, and its
    # size by that's; (3,).
    anchor: Tensor | None = None
    # Small copies (3,P,P) of the last frame, and of the last one that showed the face.
    picture: Tensor | None = None
    shown: Tensor | None = None
    # What is known of it and of somebody who passes before it; see
    # :mod:`~torchface.landmarks.images.person_identity`.
    people: Tensor = field(default_factory=lambda: torch.zeros(IDENTITY))
    missed: int = 0  # frames in a row without it
    frames: int = 0
    unconfirmed: int = 0  # checks in a row in which the detector saw no face at its place
    covered: bool = False  # whether a landmark was hidden in the last frame
    change: float = 0.0  # from the picture before to the last one, 1 less their correlation
    cut: bool = False  # whether a cut came since the face was seen
    # Its colours in the last frame that showed it, upright and small, (1200,) of unit length; not packed.
    latest_look: Tensor | None = None

    def pack(self) -> Tensor:
        """All of it as a tensor (1758,) float64; NaN for unknown."""
        size = 3 * PARTS**2
        parts = (self.place, 5), (self.anchor, 3), (self.picture, size), (self.shown, size), (self.people, IDENTITY)
        known = [torch.full((size,), torch.nan) if part is None else part.cpu().flatten() for part, size in parts]
        counts = [self.missed, self.frames, self.unconfirmed, self.covered, self.change, self.cut]
        return torch.cat([*(part.double() for part in known), torch.tensor(counts, dtype=torch.float64)])

    @classmethod
    def unpack(cls, packed: Tensor) -> "FollowedFace":
        """What :meth:`pack` packed."""
        if packed.shape != (MEMORY,):
            raise ShapeError(f"resume: found a memory of {tuple(packed.shape)}, expected ({MEMORY},)")
        size = 3 * PARTS**2
        *parts, people, counts = packed.float().split([5, 3, size, size, IDENTITY, 6])
        place, anchor, picture, shown = (part if bool(torch.isfinite(part).all()) else None for part in parts)
        picture, shown = (None if part is None else part.view(3, PARTS, PARTS) for part in (picture, shown))
        missed, frames, unconfirmed, covered, change, cut = counts.nan_to_num(0.0).tolist()
        return cls(
            place,
            anchor,
            picture,
            shown,
            people.nan_to_num(0.0),
            int(missed),
            int(frames),
            int(unconfirmed),
            covered > 0,
            change,
            cut > 0,
        )

    def take_picture(self, image: Tensor) -> None:
        """Notes how a frame (H,W) or (3,H,W) looks, and whether a cut lies before it."""
        picture = small_copy(image.expand(3, -1, -1).permute(1, 2, 0))
        if self.picture is not None:
            cut, change = sudden_change(self.picture, picture, torch.tensor(self.change))
            self.cut, self.change = self.cut or bool(cut), float(change)
        self.picture = picture

    def is_new(self, box: Tensor, shape: torch.Size) -> bool:
        """Whether the last frame, of a shape (...,H,W), shows something else in a box (4,) than when the face was
        seen."""
        if self.picture is None or self.shown is None:
            return True
        cell = box.new_tensor([shape[-1], shape[-2]]) / PARTS
        left, top = (box[:2] / cell).floor().clamp(0, PARTS - 2).int().tolist()
        right, bottom = ((box[:2] + box[2:]) / cell).ceil().clamp(2, PARTS).int().tolist()
        now, then = (face_look(one[:, top:bottom, left:right]) for one in (self.picture, self.shown))
        return float(now @ then) < _UNCHANGED

    def forget_place(self) -> None:
        """After a cut: it is known how the face looks, and no more."""
        self.place = self.anchor = None
        self.people = look_alone(self.people)

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
