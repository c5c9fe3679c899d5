"""People left out: which of three methods comes nearest to their true expressions."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface import BlendshapeRig
from torchface.modeling import ExpressionRegression, transfer_deformation
from torchface.progress import Progress, silent
from torchface.rendering.clay_shading import render
from torchface.rendering.compositing import caption, headed, heat_colors, sheet
from torchface.viz import clay_colors, frame_face

from .people_samples import People

METHODS = ("deformation transfer", "mean offset", "regression")
_MANY, _TESTED = 100, 50
"""People: of more than the first, so many are left out together, once, so that time grows with their number only."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Squared errors of every person left out, mm², in the order of ``METHODS``."""

    squared: Tensor  # (M,N,3), summed over the vertices
    names: tuple[str, ...]
    predicted: dict[int, Tensor]  # offsets (3,N,V,3) of those people who are kept for pictures, by their number
    learned: int  # how many people each was predicted from
    distances: Tensor  # of each from those, (M,); see ExpressionRegression.distance

    def expected(self) -> Tensor:
        """Mean squared errors of regression, at distance 0, and of transfer, (2,N)."""
        regression = self.squared[..., 2] / (1 + self.distances[:, None] ** 2)
        return torch.stack([regression.mean(0), self.squared[..., 0].mean(0)])

    @property
    def counts(self) -> list[int]:
        """In how many cases a method has the lowest error."""
        best = self.squared.argmin(-1).flatten()
        return [int((best == i).sum()) for i in range(len(METHODS))]

    @property
    def sums(self) -> Tensor:
        """Squared errors summed over all cases, (3,)."""
        return self.squared.sum((0, 1))

    def metrics(self) -> dict[str, float]:
        """The table as numbers by name."""
        cases = self.squared.shape[0] * self.squared.shape[1]
        metrics = {
            f"lowest error of {cases} cases, share: {m}": c / cases for m, c in zip(METHODS, self.counts, strict=True)
        }
        metrics |= {f"summed squared error, mm²: {m}": float(s) for m, s in zip(METHODS, self.sums, strict=True)}
        metrics["squared error of the mean offset's"] = float(self.sums[2] / self.sums[1])
        metrics["squared error of transfer's"] = float(self.sums[2] / self.sums[0])
        return metrics

    def __str__(self) -> str:
        cases = self.squared.shape[0] * self.squared.shape[1]
        lines = [f"{'method':24}{'count':>7}{'share':>8}{'SSE, mm²':>14}"]
        for name, count, total in zip(METHODS, self.counts, self.sums.tolist(), strict=True):
            lines.append(f"{name:24}{count:7d}{count / cases:8.0%}{total:14.3e}")
        lines.append(f"regression: {self.sums[2] / self.sums[1]:.3f} of the mean offset's squared error, ")
        lines[-1] += f"{self.sums[2] / self.sums[0]:.3f} of transfer's"
        return "\n".join(lines)


def compare(
    people: People,
    fit: Callable[[People], ExpressionRegression],
    template: BlendshapeRig | None = None,
    keep: int = 0,
    progress: Progress | None = None,
) -> Comparison:
    """Table 1 of the thesis: each person is predicted from the others.

    Of more than a hundred people the last fifty are predicted, all from the others.

    Source: thesis 3.3.4, table 1.
    """
    progress = progress or silent
    count = len(people.who)
    tested = range(count) if count <= _MANY else range(count - _TESTED, count)
    squared = torch.zeros(len(tested), len(people.names), len(METHODS), dtype=torch.float64)
    distances = torch.zeros(len(tested), dtype=torch.float64)
    predicted = {}
    learned: _Learned | None = None
    for row, i in enumerate(tested):
        if learned is None or count <= _MANY:
            learned = _learned(people.without(i) if count <= _MANY else people.first(tested.start), fit)
        source = learned.mean if template is None else template
        neutral, offsets = people.neutral(i), people.offsets_of(i)
        predictions = torch.stack(
            [
                transfer_deformation(source, people.template.with_vertices(neutral)).deltas,
                learned.mean.deltas,
                learned.model.offsets(neutral[None])[0],
            ]
        )
        distances[row] = learned.model.distance(neutral[None])[0]
        squared[row] = (predictions - offsets).double().square().sum((-1, -2)).T
        if row < keep:
            predicted[i] = predictions
        progress("predicting people from the others", row + 1, len(tested))
    others = count - (1 if count <= _MANY else _TESTED)
    return Comparison(squared, people.names, predicted, others, distances)


@dataclass(frozen=True, eq=False)
class _Learned:
    """What the others predict: their mean and a regression."""

    mean: BlendshapeRig
    model: ExpressionRegression


def _learned(people: People, fit: Callable[[People], ExpressionRegression]) -> _Learned:
    return _Learned(people.mean_rig(), fit(people))


def picture(people: People, comparison: Comparison, expression: int = 0) -> Tensor:
    """Figure 49: a row a person: what each method makes of the neutral, painted with the distance to the truth."""
    rows = []
    worst = max(
        float((predictions[:2, expression] - people.offsets_of(i)[expression]).norm(dim=-1).max())
        for i, predictions in comparison.predicted.items()
    )
    for i, predictions in comparison.predicted.items():
        neutral = people.template.with_vertices(people.neutral(i))
        camera = frame_face(neutral, 20.0, width=300, height=360)
        for method, offsets in zip(METHODS, predictions[:, expression], strict=True):
            residual = (offsets - people.offsets_of(i)[expression]).norm(dim=-1)
            face = neutral.with_vertices(neutral.vertices + offsets)
            shown = render(face, camera, heat_colors(residual, worst), samples=2)
            rows.append(caption(shown, f"{method}: worst {residual.max():.2f} mm"))
        truth = neutral.with_vertices(neutral.vertices + people.offsets_of(i)[expression])
        rows.append(caption(render(truth, camera, clay_colors(truth), samples=2), "truth"))
        rows.append(caption(render(neutral, camera, clay_colors(neutral), samples=2), "neutral"))
    return headed(sheet(rows, 5), f"{people.names[expression]}: distance to the truth, red is {worst:.1f} mm")
