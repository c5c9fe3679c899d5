"""What networks read of one face in one picture."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

__all__ = ["FaceReading"]


@dataclass(frozen=True, eq=False)
class FaceReading:
    """One face in one picture; the person's right eye (iBUG's 36 to 41) comes before the left (42 to 47).

    Args:
        landmarks: iBUG's 68, (68,2) pixels of the whole picture, centres at integers; NaN where there is no face.
        deviation: what each landmark is expected to be off by, standard deviation of a coordinate, (68,) pixels.
        visibility: (68,) in [0,1]: how likely nothing stands before the landmark.
        presence: () in [0,1]: how likely there is a face; 0 where none was found.
        iris: centres of the irises, (2,2) pixels; NaN where there is no face.
        openness: distance of the lids over that of the eye's corners, (2,).
        closed: (2,) in [0,1]: how likely the eye is shut.
        eye_visibility: (2,) in [0,1]: how likely nothing hides the eye.

    Example:
        >>> sure, eyes = torch.ones(68), torch.ones(2)
        >>> face = FaceReading(torch.zeros(68, 2), sure, sure, eyes[0], torch.zeros(2, 2), 0.3 * eyes, 0 * eyes, eyes)
        >>> face.closed.tolist()  # both eyes are open
        [0.0, 0.0]
    """

    landmarks: Tensor
    deviation: Tensor
    visibility: Tensor
    presence: Tensor
    iris: Tensor
    openness: Tensor
    closed: Tensor
    eye_visibility: Tensor
