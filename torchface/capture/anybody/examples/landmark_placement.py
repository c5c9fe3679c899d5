"""Placement of a face in the picture, position and size, in a solve from its landmarks."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchface.capture.anybody.examples.example_shapes import EYE_CORNERS
from torchface.capture.anybody.examples.landmark_equations import LandmarkEquations

_BROWS = slice(17, 27)
_SMALLEST = 1e-6


@dataclass(frozen=True, eq=False)
class Placement:
    r""":math:`p = M x + t` from example to picture, a frame each: M (B,2,2), t (B,2) pixels."""

    matrix: Tensor
    translation: Tensor

    def apply(self, points: Tensor) -> Tensor:
        """Points (B,68,2) of examples in the picture."""
        return points @ self.matrix.transpose(-1, -2) + self.translation[:, None]


class PlacementModel(Protocol):
    """Says how landmarks in a picture and examples lie to each other."""

    def equations(self, landmarks: Tensor, neutral: Tensor, basis: Tensor) -> LandmarkEquations: ...

    def placement(self, landmarks: Tensor, neutral: Tensor, free: Tensor) -> Placement: ...


@dataclass(frozen=True)
class LandmarkBoxes:
    r"""The paper's placement: the box round the landmarks without the brows lies where the neutral example's lies.

    .. math:: p = s \circ x + t

    with s the ratio of widths and of heights and t from the boxes' middles. A jaw that opens makes the box higher, and
    so the whole face; a head that leans makes it wider.

    Source: realtime_facial_animation 5.2.2, listings 1 and 2. Whole pixels, to which its boxes were cut, are not.

    Example:
        >>> from torchface.capture.anybody import ExampleSolver, paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> solver = ExampleSolver(examples, placement=LandmarkBoxes())
        >>> farther = 0.5 * examples.neutral.double() + 40.0
        >>> bool(solver(farther[None]).max() < 0.01)
        True
    """

    def equations(self, landmarks: Tensor, neutral: Tensor, basis: Tensor) -> LandmarkEquations:
        """Equations of the weights alone: the placement is known.

        Args:
            landmarks: (B,68,2), pixels; NaN where not seen.
            neutral: (68,2).
            basis: (68,2,N).
        """
        scale, translation, seen = self._boxes(landmarks, neutral)
        known = torch.where(seen[..., None], landmarks, neutral)
        inside = (known - translation[:, None]) / scale[:, None]
        eyes = (scale * (neutral[EYE_CORNERS[0]] - neutral[EYE_CORNERS[1]])).norm(dim=-1, keepdim=True)
        return LandmarkEquations(
            neutral, basis, neutral - inside, scale / eyes, seen, inside.new_zeros(*inside.shape, 0)
        )

    def placement(self, landmarks: Tensor, neutral: Tensor, free: Tensor) -> Placement:
        """The placement of landmarks (B,68,2) by their boxes and the neutral's (68,2)."""
        scale, translation, _ = self._boxes(landmarks, neutral)
        return Placement(torch.diag_embed(scale), translation)

    @staticmethod
    def _boxes(landmarks: Tensor, neutral: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        seen = torch.isfinite(landmarks).all(-1)
        counted = seen.clone()
        counted[:, _BROWS] = False
        # Boxes of the same landmarks: what is hidden here is left out there too.
        here, there = _box(landmarks, counted), _box(neutral.expand_as(landmarks), counted)
        smallest = _SMALLEST * (neutral.amax(0) - neutral.amin(0))
        size = there[1].maximum(smallest)
        scale = torch.where(there[1] > smallest, here[1] / size, 1.0).clamp(min=_SMALLEST)
        return scale, here[0] - scale * there[0], seen


@dataclass(frozen=True)
class SolvedSimilarity:
    r"""Size, roll and place are solved for together with the weights.

    The similarity that brings the picture's landmarks p to the examples is linear in four numbers:

    .. math:: r_i = (a p_i + c J p_i + b) - (e_{0i} + \sum_k w_k (e_{ki} - e_{0i})), \quad J = (0, -1; 1, 0)

    so that weights and placement come out of one quadratic program, and an open jaw is no larger face.

    Example:
        >>> from torchface.capture.anybody import ExampleSolver, paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> solver = ExampleSolver(examples, placement=SolvedSimilarity())
        >>> farther = 0.5 * examples.neutral.double() + 40.0
        >>> bool(solver(farther[None]).max() < 0.01)
        True
    """

    def equations(self, landmarks: Tensor, neutral: Tensor, basis: Tensor) -> LandmarkEquations:
        """Equations of weights and placement; see :meth:`LandmarkBoxes.equations`."""
        guessed, seen, *_ = self._guessed(landmarks, neutral)
        middle = _mean(guessed, seen)
        centred = torch.where(seen[..., None], guessed - middle, 0.0)
        turned = torch.stack([-centred[..., 1], centred[..., 0]], dim=-1)
        one = torch.eye(2, dtype=guessed.dtype, device=guessed.device).expand(*guessed.shape[:2], 2, 2)
        eyes = (neutral[EYE_CORNERS[0]] - neutral[EYE_CORNERS[1]]).norm()
        free = -torch.cat([centred[..., None], turned[..., None], eyes * one], dim=-1)
        scale = (1 / eyes).expand(landmarks.shape[0], 2)
        offset = torch.where(seen[..., None], neutral - guessed, 0.0)
        return LandmarkEquations(neutral, basis, offset, scale, seen, free)

    def placement(self, landmarks: Tensor, neutral: Tensor, free: Tensor) -> Placement:
        """The placement of the four numbers (B,4) that were solved for."""
        guessed, seen, size, here, there = self._guessed(landmarks, neutral)
        middle = _mean(guessed, seen)[:, 0]
        along, across = 1 + free[:, 0], free[:, 1]
        back = torch.stack([along, -across, across, along], dim=-1).unflatten(-1, (2, 2))  # of what was guessed
        shift = middle + free[:, 2:] * (neutral[EYE_CORNERS[0]] - neutral[EYE_CORNERS[1]]).norm()
        # x = back (g - middle) + shift with g = (p - here) / size + there.
        inverse = torch.linalg.inv(back)
        matrix = size[:, None] * inverse
        translation = here[:, 0] + size * (middle - there[:, 0]) - (matrix @ shift[..., None])[..., 0]
        return Placement(matrix, translation)

    @staticmethod
    def _guessed(landmarks: Tensor, neutral: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Landmarks brought near the neutral by mean and spread, which are seen, and the three that did it."""
        seen = torch.isfinite(landmarks).all(-1)
        known = torch.where(seen[..., None], landmarks, neutral)
        here, there = _mean(known, seen), _mean(neutral.expand_as(known), seen)
        spread = _spread(known - here, seen) / _spread(neutral - there, seen).clamp(min=_SMALLEST)
        size = spread.clamp(min=_SMALLEST)[:, None]
        return (known - here) / size[:, None] + there, seen, size, here, there


def _box(points: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
    """Middle and size (B,2) of the box round points (B,68,2) of which some count (B,68); 0 where none does."""
    low = torch.where(counted[..., None], points, torch.inf).amin(1)
    high = torch.where(counted[..., None], points, -torch.inf).amax(1)
    some = counted.any(1, keepdim=True)
    return torch.where(some, (low + high) / 2, 0.0), torch.where(some, high - low, 0.0)


def _mean(points: Tensor, seen: Tensor) -> Tensor:
    """Of points (B,68,2) that are seen, (B,1,2)."""
    counted = seen[..., None]
    return torch.where(counted, points, 0.0).sum(1, keepdim=True) / counted.sum(1, keepdim=True).clamp(min=1)


def _spread(points: Tensor, seen: Tensor) -> Tensor:
    """Root mean square of points (B,68,2) that are seen, (B,)."""
    squared = torch.where(seen[..., None], points, 0.0).square().sum((1, 2))
    return (squared / seen.sum(1).clamp(min=1)).clamp(min=_SMALLEST**2).sqrt()
