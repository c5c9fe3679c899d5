"""Pictures of a head model, after the thesis's figures 20 to 24, and curves of how good it is."""

from collections.abc import Callable
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchface.files.whole_files import make_folder
from torchface.geometry.sample_batches import Samples, blocks
from torchface.modeling import HeadModel, MorphableModel
from torchface.progress import Progress
from torchface.rendering.compositing import from_figure, save_rendered_image, sheet
from torchface.viz import modes_figure, random_figure
from torchface.viz.figures.face_views import FRONT, THREE_QUARTER
from torchface.viz.figures.model_figures import head_views

from .model_quality import ModelQuality

_STEPS = 6
_DEVIATIONS = 3.0
_MODES = 5
_FAR = 5.0
"""Times as far from the mean as heads are: well outside the data."""


def draw(
    model: HeadModel,
    folder: Path,
    seed: int,
    quality: ModelQuality | None,
    learn: Samples | None,
    test: Samples | None,
    progress: Progress,
) -> None:
    """Writes the pictures of the heads learned from and of others, and of the quality measured, into a folder."""
    make_folder(folder)
    known, others = (
        torch.cat([model.shape.project(part.read(*block)) for block in blocks(part)])
        if part is not None and part.shape[0]
        else None
        for part in (learn, test)
    )
    pictures: dict[str, Callable[[], Tensor]] = {
        "modes": lambda: modes_figure(model),
        "random": lambda: random_figure(model, seed=seed),
        "morph": lambda: morph_figure(model, seed=seed),
        "far": lambda: extrapolation_figure(model, seed=seed),
    }
    if known is not None:
        pictures["components"] = lambda: scatter_figure(model.shape, known, others)
    if model.color is not None:
        pictures["color_modes"] = lambda: color_modes_figure(model)
    if quality is not None:
        pictures["quality"] = lambda: quality_figure(quality)
    for number, (name, picture) in enumerate(pictures.items()):
        progress("drawing pictures", number, len(pictures))
        save_rendered_image(picture(), folder / f"{name}.png")


def color_modes_figure(model: HeadModel) -> Tensor:
    """The mean face between -3σ and +3σ of the first modes of colour, a row a mode."""
    if model.color is None:
        return sheet([head_views(model, model.template(), "no colours")], 1)
    still, cells = torch.zeros(model.shape.count), []
    for mode in range(min(_MODES, model.color.count)):
        for amount in (-_DEVIATIONS, 0.0, _DEVIATIONS):
            coefficients = torch.zeros(model.color.count)
            coefficients[mode] = amount
            label = "mean" if amount == 0 else f"colour {mode + 1}, {amount:+g} sd"
            cells.append(head_views(model, model.mesh(still, coefficients), label, (FRONT,)))
    return sheet(cells, 3)


def morph_figure(model: HeadModel, seed: int = 1) -> Tensor:
    """The straight line from one random head to another (figure 23)."""
    generator = torch.Generator().manual_seed(seed)
    paths = []
    for part in (model.shape, model.color):
        ends = None if part is None else part.sample(2, generator)
        paths.append(None if part is None or ends is None else part.interpolate(ends[0], ends[1], _STEPS))
    shapes, colors = paths
    assert shapes is not None
    heads = [model.mesh(shapes[i], None if colors is None else colors[i]) for i in range(_STEPS)]
    labels = [f"{i / (_STEPS - 1):.0%}" for i in range(_STEPS)]
    return sheet(
        [head_views(model, mesh, label, (THREE_QUARTER,)) for mesh, label in zip(heads, labels, strict=True)], 6
    )


def extrapolation_figure(model: HeadModel, seed: int = 2) -> Tensor:
    """One random head where the model was learned, and the same direction followed far outside (figure 22)."""
    direction = torch.nn.functional.normalize(model.shape.sample(1, torch.Generator().manual_seed(seed))[0], dim=0)
    root = model.shape.count**0.5  # how far heads of the model lie from the mean
    amounts = (0.0, root, _FAR * root)
    labels = ("mean", "a head of the model", f"{_FAR:g} times as far")
    cells = [head_views(model, model.mesh(a * direction), label) for a, label in zip(amounts, labels, strict=True)]
    return sheet(cells, 3)


def quality_figure(quality: ModelQuality) -> Tensor:
    """Compactness, generalisation and specificity over the number of components."""
    figure = Figure(figsize=(12, 3.4), dpi=100, layout="constrained")
    panels = figure.subplots(1, 3)
    numbers = quality.components
    reach = 1.1 * max(quality.nearest, float(quality.specificity.max()))
    curves = (
        ("compactness", quality.compactness, "explained variance", (0, 1.02)),
        ("generalisation, one left out", quality.generalisation, "error (mm)", (0, None)),
        ("specificity", quality.specificity, "distance to the nearest sample (mm)", (0, reach)),
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
    """Training samples (M,K) and others (L,K) along the first three components, two at a time (figure 24)."""
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
