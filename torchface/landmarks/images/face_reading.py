"""Reading of a face, in one picture or in those of a take."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torchface.landmarks.images.ibug_68 import COUNT, box_around
from torchface.shape_names import ARKIT

READ_FOR_SOLVER = (
    "landmarks", "deviation", "visibility", "presence", "iris", "openness", "closed", "eye_visibility", "expression",
    "expression_deviation",
)  # fmt: skip
"""The parts of a reading that a webcam's solver takes, in its order."""

LEAST_VISIBLE = 20.0
"""Visible landmarks that a face has at least which a webcam's reader finds and its solver solves."""

HALF_CONFIDENCE = 0.02  # the deviation, in sides of the face's box, of a confidence of one half

_HIDDEN, _VISIBLE = 0.7, 0.95
_LIPS, _CHIN, _CONTOUR = slice(48, 68), slice(4, 13), 17
_GROUPS = (slice(17, 22), slice(22, 27), slice(27, 36), slice(36, 42), slice(42, 48), _LIPS)  # brows, nose, eyes, lips

_UNREAD: dict[str, tuple[tuple[int, ...], float]] = {
    "iris": ((2, 2), torch.nan), "openness": ((2,), torch.nan), "closed": ((2,), torch.nan),
    "eye_visibility": ((2,), 0.0), "points": ((0, 2), torch.nan), "point_deviation": ((0,), torch.inf),
    "expression": ((len(ARKIT),), torch.nan), "expression_deviation": ((len(ARKIT),), torch.inf),
}  # fmt: skip
"""Shape and value of what nothing has read."""


@dataclass(frozen=True, eq=False)
class FaceReading:
    """One face in one picture, or in the T pictures of a take: then every part has T rows.

    The person's right eye (iBUG's 36 to 41) comes before the left (42 to 47).

    Args:
        landmarks: iBUG's 68, (...,68,2) pixels of the whole picture, centres at integers; NaN where there is no face.
        deviation: what each landmark is expected to be off by, standard deviation of a coordinate, (...,68) pixels;
            infinite where nothing is known.
        visibility: (...,68) in [0,1]: how likely nothing stands before the landmark.
        presence: (...) in [0,1]: how likely there is a face; 0 where none was found.
        iris: centres of the irises, (...,2,2) pixels; NaN, if absent too, where nobody looked at the eyes.
        openness: distance of the lids over that of the eye's corners, (...,2); likewise.
        closed: (...,2) in [0,1]: how likely the eye is shut; likewise.
        eye_visibility: (...,2) in [0,1]: how likely nothing hides the eye; 0 where nobody looked.
        points: other points of the face's surface, those of the network that found them, (...,P,2) pixels of the whole
            picture; P is 0 if absent, NaN where there is no face.
        point_deviation: standard deviation of a coordinate of each, (...,P) pixels: large where a point is hidden.
        expression: weights of blendshapes by ARKit's names, as they are to be expected of the picture alone, (...,52);
            NaN, if absent too, where nothing read them.
        expression_deviation: standard deviation of the truth about them, (...,52); infinite for what cannot be seen.
        search_box: x, y, width, height of the box that the face was looked for in, (...,4) pixels; the box round the
            landmarks if absent.

    Example:
        >>> sure = torch.ones(68)
        >>> face = FaceReading(torch.rand(68, 2) * 60, sure, sure, sure[0], search_box=torch.tensor([0.0, 0, 50, 50]))
        >>> face.confidence[0].item()  # a pixel is a fiftieth of the box
        0.5
        >>> bool(FaceReading.lost().found)
        False
    """

    landmarks: Tensor
    deviation: Tensor
    visibility: Tensor
    presence: Tensor
    iris: Tensor = None  # type: ignore[assignment]
    openness: Tensor = None  # type: ignore[assignment]
    closed: Tensor = None  # type: ignore[assignment]
    eye_visibility: Tensor = None  # type: ignore[assignment]
    points: Tensor = None  # type: ignore[assignment]
    point_deviation: Tensor = None  # type: ignore[assignment]
    expression: Tensor = None  # type: ignore[assignment]
    expression_deviation: Tensor = None  # type: ignore[assignment]
    search_box: Tensor = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        lead = self.landmarks.shape[:-2]
        for name, (shape, value) in _UNREAD.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, self.landmarks.new_full((*lead, *shape), value))
        if self.search_box is None and self.landmarks.shape[-2:] == (COUNT, 2):
            object.__setattr__(self, "search_box", box_around(self.landmarks))

    @classmethod
    def of_confidence(
        cls, landmarks: Tensor, confidence: Tensor, visibility: Tensor, presence: Tensor, search_box: Tensor
    ) -> FaceReading:
        """A reading by what gives confidences (...,68) in [0,1] rather than deviations."""
        deviation = box_side(search_box)[..., None] * HALF_CONFIDENCE * (1 / confidence - 1).clamp(min=0).sqrt()
        return cls(landmarks, deviation, visibility, presence, search_box=search_box)

    @classmethod
    def lost(cls) -> FaceReading:
        """No face."""
        nothing = torch.zeros(COUNT)
        return cls(torch.full((COUNT, 2), torch.nan), nothing + torch.inf, nothing, torch.zeros(()))

    @classmethod
    def stacked(cls, readings: Sequence[FaceReading]) -> FaceReading:
        """A take's reading (T,...) of its frames', one at least; where points were not looked for they are NaN."""
        return cls._combined(torch.stack, readings)

    @classmethod
    def joined(cls, readings: Sequence[FaceReading]) -> FaceReading:
        """A take's reading of its pieces', one at least; likewise."""
        return cls._combined(torch.cat, readings)

    @classmethod
    def _combined(cls, combine: Callable[[list[Tensor]], Tensor], readings: Sequence[FaceReading]) -> FaceReading:
        count = max(one.points.shape[-2] for one in readings)
        filled = [one._with_points(count) for one in readings]
        return cls(*(combine([getattr(one, part.name) for one in filled]) for part in fields(cls)))

    def _with_points(self, count: int) -> FaceReading:
        """The same with so many points, NaN and infinitely uncertain if it has none."""
        if self.points.shape[-2] == count:
            return self
        lead = self.landmarks.shape[:-2]
        points, deviation = (
            self.landmarks.new_full((*lead, *size), value)
            for size, value in (((count, 2), torch.nan), ((count,), torch.inf))
        )
        return replace(self, points=points, point_deviation=deviation)

    def of_frames(self, frames: Tensor) -> FaceReading:
        """Of a take's reading (T,...) that of some frames, (F,) int64."""
        return FaceReading(*(getattr(self, part.name)[frames] for part in fields(self)))

    def doubted(self, landmarks: Tensor) -> FaceReading:
        """The same with no confidence in some of the landmarks, (...,68) bool."""
        return replace(self, deviation=torch.where(landmarks, torch.inf, self.deviation))

    @property
    def found(self) -> Tensor:
        """Whether there is a face, (...) bool: any landmark of it."""
        return torch.isfinite(self.landmarks).all(-1).any(-1)

    @property
    def box(self) -> Tensor:
        """x, y, width, height round the face as a detector draws it, (...,4) pixels; NaN where there is none."""
        return box_around(self.landmarks)

    @property
    def confidence(self) -> Tensor:
        r""":math:`1 / (1 + (s/0.02)^2)` of deviations s in sides of the search box, (...,68) in [0,1]: one half where a
        landmark may be off by 0.02 of the side, 0 where there is no face."""
        return confidence_of(self.deviation / box_side(self.search_box)[..., None]).nan_to_num(0.0)

    @property
    def trust(self) -> Tensor:
        """See :func:`trust_of`, (...,68) in [0,1]."""
        return trust_of(self.confidence, self.visibility)

    @property
    def trusted_landmarks(self) -> Tensor:
        """The landmarks (...,68,2), NaN where they are not trusted at all: hidden ones are guesses, which filters would
        carry on into the frames after."""
        return torch.where(self.trust[..., None] > 0, self.landmarks, torch.nan)


def box_side(box: Tensor) -> Tensor:
    """The side (...) of the square of a box's area, of boxes (...,4)."""
    return (box[..., 2] * box[..., 3]).clamp(min=0).sqrt()


def confidence_of(deviation: Tensor) -> Tensor:
    r""":math:`1 / (1 + (s/0.02)^2)` of deviations s in sides of the face's box: one half at 0.02."""
    return 1 / (1 + (deviation / HALF_CONFIDENCE).square())


def trust_of(confidence: Tensor, visibility: Tensor) -> Tensor:
    """How much each landmark counts, (...,68) in [0,1]: its confidence, if it is visible and so is what it belongs to.

    A landmark behind a hand is a guess, however sure: below a visibility of 0.7 it does not count at all, above 0.95
    fully. Brows, nose, eyes and lips are each hidden as a whole where they are hidden in the mean: from a few points
    beside a hand a mouth would be invented.
    """
    parts = [visibility[..., group] for group in _GROUPS]
    whole = [part.minimum(part.mean(-1, keepdim=True)) for part in parts]
    # Who hides the mouth hides the chin: what is found of it would open the jaw.
    contour, lips = visibility[..., :_CONTOUR], parts[-1].mean(-1, keepdim=True)
    jaw = contour[..., : _CHIN.start], contour[..., _CHIN].minimum(lips), contour[..., _CHIN.stop :]
    visible = torch.cat([*jaw, *whole], dim=-1)
    return confidence * ((visible - _HIDDEN) / (_VISIBLE - _HIDDEN)).clamp(0, 1)
