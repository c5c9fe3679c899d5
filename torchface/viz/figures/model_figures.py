"""Figures of a head model, after the thesis's figures 20 to 24, and curves of how good it is."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchface.mesh import Mesh
from torchface.modeling.morphable.head_model import HeadModel
from torchface.modeling.morphable.model_quality import ModelQuality
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.rendering.clay_shading import Lighting
from torchface.rendering.compositing import caption, from_figure, sheet
from torchface.viz.figures.face_views import FRONT, THREE_QUARTER, face_views

FAR = 5.0
"""Times as far from the mean as heads are: well outside the data."""

_WIDTH, _HEIGHT = 220, 275
_LIGHT = Lighting(occlusion_rays=0)  # seventy faces a model: shadows in creases would take most of the time


def modes_figure(model: HeadModel, count: int = 5, deviations: float = 3.0) -> Tensor:
    """The mean between -3σ and +3σ of the first modes of shape, a row a mode, each from two sides (figure 20)."""
    rows = []
    for mode in range(min(count, model.shape.count)):
        row = []
        for amount in (-deviations, 0.0, deviations):
            coefficients = torch.zeros(model.shape.count)
            coefficients[mode] = amount
            label = "mean" if amount == 0 else f"mode {mode + 1}, {amount:+g} sd"
            row.append(_face(model, model.mesh(coefficients), label))
        rows += row
    return sheet(rows, 3)


def color_modes_figure(model: HeadModel, count: int = 5, deviations: float = 3.0) -> Tensor:
    """The mean face between -3σ and +3σ of the first modes of colour, a row a mode."""
    if model.color is None:
        return sheet([_face(model, model.template(), "no colours")], 1)
    still, cells = torch.zeros(model.shape.count), []
    for mode in range(min(count, model.color.count)):
        for amount in (-deviations, 0.0, deviations):
            coefficients = torch.zeros(model.color.count)
            coefficients[mode] = amount
            label = "mean" if amount == 0 else f"colour {mode + 1}, {amount:+g} sd"
            cells.append(_face(model, model.mesh(still, coefficients), label, (FRONT,)))
    return sheet(cells, 3)


def random_figure(model: HeadModel, count: int = 12, seed: int = 0) -> Tensor:
    """Random heads of the model (figure 21)."""
    generator = torch.Generator().manual_seed(seed)
    heads = [_drawn(model, generator) for _ in range(count)]
    return sheet([_face(model, mesh, None, (THREE_QUARTER,)) for mesh in heads], 6)


def morph_figure(model: HeadModel, steps: int = 6, seed: int = 1) -> Tensor:
    """The straight line from one random head to another (figure 23)."""
    generator = torch.Generator().manual_seed(seed)
    paths = []
    for part in (model.shape, model.color):
        ends = None if part is None else part.sample(2, generator)
        paths.append(None if part is None or ends is None else part.interpolate(ends[0], ends[1], steps))
    shapes, colors = paths
    assert shapes is not None
    heads = [model.mesh(shapes[i], None if colors is None else colors[i]) for i in range(steps)]
    labels = [f"{i / (steps - 1):.0%}" for i in range(steps)]
    return sheet([_face(model, mesh, label, (THREE_QUARTER,)) for mesh, label in zip(heads, labels, strict=True)], 6)


def extrapolation_figure(model: HeadModel, deviations: float = FAR, seed: int = 2) -> Tensor:
    """One random head where the model was learned, and the same direction followed far outside (figure 22)."""
    direction = torch.nn.functional.normalize(model.shape.sample(1, torch.Generator().manual_seed(seed))[0], dim=0)
    root = model.shape.count**0.5  # how far heads of the model lie from the mean
    amounts = (0.0, root, deviations * root)
    labels = ("mean", "a head of the model", f"{deviations:g} times as far")
    cells = [_face(model, model.mesh(a * direction), label) for a, label in zip(amounts, labels, strict=True)]
    return sheet(cells, 3)


def quality_figure(quality: ModelQuality, unit: str = "mm") -> Tensor:
    """Compactness, generalisation and specificity over the number of components."""
    figure = Figure(figsize=(12, 3.4), dpi=100, layout="constrained")
    panels = figure.subplots(1, 3)
    numbers = quality.components
    reach = 1.1 * max(quality.nearest, float(quality.specificity.max()))
    curves = (
        ("compactness", quality.compactness, "explained variance", (0, 1.02)),
        ("generalisation, one left out", quality.generalisation, f"error ({unit})", (0, None)),
        ("specificity", quality.specificity, f"distance to the nearest sample ({unit})", (0, reach)),
    )
    for axes, (title, values, label, limits) in zip(panels, curves, strict=True):
        axes.plot(numbers, values, color="#1f5fa8", marker="o" if len(numbers) < 15 else None, markersize=3)
        axes.set(title=title, xlabel="components", ylabel=label, ylim=limits)
        axes.grid(alpha=0.3)
    deviation = 2 * quality.generalisation_error
    low, high = quality.generalisation - deviation, quality.generalisation + deviation
    panels[1].fill_between(numbers, low, high, color="#1f5fa8", alpha=0.2, label="± 2 standard errors")
    panels[1].legend(frameon=False)
    panels[2].axhline(quality.nearest, color="grey", linestyle="--", label="between samples")
    panels[2].legend(frameon=False)
    return from_figure(figure)


def scatter_figure(model: MorphableModel, coefficients: Tensor, held_out: Tensor | None = None) -> Tensor:
    """Samples along the first three components, two at a time (figure 24).

    Args:
        model: that they are coefficients of.
        coefficients: of the training samples, (M,K).
        held_out: of others, (L,K).
    """
    figure = Figure(figsize=(12, 4.2), dpi=100, layout="constrained")
    explained = model.standard_deviations.double().square() / model.total_variance.double()
    count = model.count
    for axes, (a, b) in zip(figure.subplots(1, 3), ((0, 1), (0, 2), (1, 2)), strict=True):
        if b >= count:
            axes.set_axis_off()
            continue
        axes.scatter(coefficients[:, a], coefficients[:, b], s=9, color="#1f5fa8", label="learned from")
        if held_out is not None and len(held_out):
            axes.scatter(held_out[:, a], held_out[:, b], s=14, color="#d9822b", marker="x", label="held out")
        axes.set(
            xlabel=f"component {a + 1} ({float(explained[a]):.0%}), σ",
            ylabel=f"component {b + 1} ({float(explained[b]):.0%}), σ",
        )
        axes.set_aspect("equal")
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize=8)
    return from_figure(figure)


def _drawn(model: HeadModel, generator: torch.Generator) -> Mesh:
    shape = model.shape.sample(1, generator)[0]
    return model.mesh(shape, None if model.color is None else model.color.sample(1, generator)[0])


def _face(model: HeadModel, mesh: Mesh, label: str | None, yaws: tuple[float, ...] = (FRONT, THREE_QUARTER)) -> Tensor:
    """Always framed alike, so that size and place show, with room for the whole of every head."""
    row = face_views(mesh, yaws, width=_WIDTH, height=_HEIGHT, framed_by=_room(model), lighting=_LIGHT)
    return row if label is None else caption(row, label)


def _room(model: HeadModel) -> Mesh:
    """A mesh as large as heads of the model get: the mean's vertices, three deviations of each out of its middle."""
    mean = model.shape.mean
    deviation = model.shape.modes.square().sum(0).sqrt()
    return Mesh(mean + 3 * deviation * (mean - mean.mean(0)).sign(), model.faces)
