"""Leave one person out: which of three methods comes nearest to his or her true expressions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface import BlendshapeRig, Mesh
from torchface.modeling import ExpressionRegression, transfer_deformation
from torchface.progress import Progress, silent
from torchface.rendering.clay_shading import render
from torchface.rendering.compositing import caption, headed, heat_colors, sheet
from torchface.viz.figures.face_views import clay_colors, frame_face

METHODS = ("deformation transfer", "mean offset", "regression")


@dataclass(frozen=True, eq=False)
class People:
    """Who is learned from.

    Args:
        who: M names.
        template: the topology, and what is annotated on it.
        neutrals: (M,V,3), millimetres.
        offsets: of the expressions, (M,N,V,3).
        names: of the expressions.
    """

    who: tuple[str, ...]
    template: Mesh
    neutrals: Tensor
    offsets: Tensor
    names: tuple[str, ...]

    def without(self, left_out: int) -> People:
        """All but one."""
        rest = torch.arange(len(self.who)) != left_out
        who = tuple(name for name, kept in zip(self.who, rest.tolist(), strict=True) if kept)
        return People(who, self.template, self.neutrals[rest], self.offsets[rest], self.names)

    def mean_rig(self) -> BlendshapeRig:
        """The mean neutral with the mean offsets."""
        neutral = self.template.with_vertices(self.neutrals.mean(0))
        return BlendshapeRig(neutral, self.offsets.mean(0), self.names)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Squared errors of every person left out, mm², in the order of ``METHODS``.

    Args:
        squared: (M,N,3), summed over the vertices.
        names: of the expressions.
        predicted: offsets (M,3,N,V,3) of those people who are kept for pictures, else None.
    """

    squared: Tensor
    names: tuple[str, ...]
    predicted: dict[int, Tensor]

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
        found = {
            f"lowest error of {cases} cases, share: {m}": c / cases for m, c in zip(METHODS, self.counts, strict=True)
        }
        found |= {f"summed squared error, mm²: {m}": float(s) for m, s in zip(METHODS, self.sums, strict=True)}
        found["squared error of the mean offset's"] = float(self.sums[2] / self.sums[1])
        found["squared error of transfer's"] = float(self.sums[2] / self.sums[0])
        return found

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

    Args:
        people: three at least.
        fit: learns from those who are left.
        template: whose shapes are transferred; the mean of those who are left, if absent.
        keep: for how many people, the first, predictions are kept for pictures.
        progress: called with each step and how far it is.

    Source: thesis 3.3.4, table 1.
    """
    progress = progress or silent
    squared = torch.zeros(len(people.who), len(people.names), len(METHODS), dtype=torch.float64)
    predicted = {}
    for i in range(len(people.who)):
        rest = people.without(i)
        source = rest.mean_rig() if template is None else template.select(people.names)
        neutral = people.template.with_vertices(people.neutrals[i])
        predictions = torch.stack(
            [
                transfer_deformation(source, neutral).deltas,
                rest.offsets.mean(0),
                fit(rest).offsets(people.neutrals[i : i + 1])[0],
            ]
        )
        squared[i] = (predictions - people.offsets[i]).double().square().sum((-1, -2)).T
        if i < keep:
            predicted[i] = predictions
        progress("predicting each person from the others", i + 1, len(people.who))
    return Comparison(squared, people.names, predicted)


def picture(people: People, comparison: Comparison, expression: int = 0) -> Tensor:
    """Figure 49: a row a person: what each method makes of the neutral, painted with the distance to the truth."""
    rows = []
    worst = max(
        float((predictions[:2, expression] - people.offsets[i, expression]).norm(dim=-1).max())
        for i, predictions in comparison.predicted.items()
    )
    for i, predictions in comparison.predicted.items():
        neutral = people.template.with_vertices(people.neutrals[i])
        camera = frame_face(neutral, 20.0, width=300, height=360)
        for method, offsets in zip(METHODS, predictions[:, expression], strict=True):
            residual = (offsets - people.offsets[i, expression]).norm(dim=-1)
            face = neutral.with_vertices(neutral.vertices + offsets)
            shown = render(face, camera, heat_colors(residual, worst), samples=2)
            rows.append(caption(shown, f"{method}: worst {residual.max():.2f} mm"))
        truth = neutral.with_vertices(neutral.vertices + people.offsets[i, expression])
        rows.append(caption(render(truth, camera, clay_colors(truth), samples=2), "truth"))
        rows.append(caption(render(neutral, camera, clay_colors(neutral), samples=2), "neutral"))
    return headed(sheet(rows, 5), f"{people.names[expression]}: distance to the truth, red is {worst:.1f} mm")
