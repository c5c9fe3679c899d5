"""Readings of weights by networks: linear in the weights, with a deviation each, as an energy."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.capture.energy import Quadratic
from torchface.errors import ShapeError
from torchface.shape_names import ARKIT, mapping

_BLINK_DEVIATION = 0.2
LASTING = 10.0
"""How much what was read of weights counts, beside one reading of it, where a take's fixed offsets or the person's head
could explain a lasting expression instead. From 1 to 10 the error of smiles fell from 0.138 to 0.107 in rendered films.
"""
_BLINKS = [name.startswith("eyeBlink") for name in ARKIT]


def doubted_blinks(deviation: Tensor) -> Tensor:
    """Deviations (...,52) that an expression network states of ARKit's shapes, of ``eyeBlink`` at least 0.2.

    It is too sure of lids that are half closed: in a film of a half-closed eye it read 0.02 of 0.6, to 0.03, and what
    the eye network reads of the openness counted a tenth.
    """
    blinks = torch.tensor(_BLINKS, device=deviation.device)
    return torch.where(blinks, deviation.abs().clamp(min=_BLINK_DEVIATION), deviation)


@dataclass(frozen=True, eq=False)
class WeightReadings:
    r"""M readings of weights in T frames, :math:`y = A w + e` with independent Gaussian errors.

    .. math:: E(w) = \tfrac12 \sum_m \frac{(a_m^\top w - y_m)^2}{s_m^2}

    An expression network reads ARKit's shapes; how open an eye is and where it looks are such readings too.

    Args:
        rows: A, (M,N).
        values: y, (T,M); NaN for not read.
        deviation: s, (T,M), positive; infinite where nothing is known.

    Raises:
        ShapeError: the parts do not fit each other.

    Example:
        >>> read = torch.full((1, 52), 0.3)
        >>> jaw = WeightReadings.of_expression(read, 0.1 + 0 * read, ["jawOpen", "browInnerUp_L", "browInnerUp_R"])
        >>> jaw.energy().H[0].round().tolist()  # two halves are read as their mean
        [[100.0, 0.0, 0.0], [0.0, 25.0, 25.0], [0.0, 25.0, 25.0]]
    """

    rows: Tensor
    values: Tensor
    deviation: Tensor

    def __post_init__(self) -> None:
        if self.rows.ndim != 2 or self.values.ndim != 2 or self.deviation.shape != self.values.shape:
            raise ShapeError(
                f"weight readings: found rows {tuple(self.rows.shape)}, values {tuple(self.values.shape)} and "
                f"deviation {tuple(self.deviation.shape)}, expected (M,N), (T,M) and (T,M)"
            )
        if self.values.shape[1] != len(self.rows):
            raise ShapeError(f"weight readings: found {self.values.shape[1]} values a frame, expected {len(self.rows)}")

    @classmethod
    def of_expression(cls, expression: Tensor, deviation: Tensor, names: Sequence[str]) -> "WeightReadings":
        """Those of ARKit's 52 shapes, (T,52) both, of a rig whose shapes have ``names``; what it lacks says nothing."""
        return cls(mapping(names, ARKIT).to(expression), expression, doubted_blinks(deviation))

    def beside(self, other: "WeightReadings") -> "WeightReadings":
        """These and others of the same frames."""
        return WeightReadings(
            torch.cat([self.rows, other.rows.to(self.rows)]),
            torch.cat([self.values, other.values.to(self.values)], dim=1),
            torch.cat([self.deviation, other.deviation.to(self.deviation)], dim=1),
        )

    def of_frames(self, frames: Tensor) -> "WeightReadings":
        """Those of some frames, (F,) int64."""
        return WeightReadings(self.rows, self.values[frames], self.deviation[frames])

    def energy(self) -> Quadratic:
        """Of weights (T,N), float64."""
        rows, known = self.rows.double(), ~torch.isnan(self.values)
        precision = torch.where(known, self.deviation.double(), torch.inf).reciprocal().square()
        pulled = precision * torch.where(known, self.values, 0.0).double()
        return Quadratic((rows.T * precision[:, None]) @ rows, -pulled @ rows)
