"""A helmet's motion over a take, as the thesis's figures 61 and 62 show it: three translations and three rotations."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchface.rendering.compositing import from_figure
from torchface.viz.figures.curves import SOLVED, TRUE


def motion_curves(
    translation: Tensor, degrees: Tensor, fps: float, true: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """Translations (T,3), millimetres, and rotations (T,3), degrees, over time, with the true ones if any; (3,H,W)."""
    figure = Figure(figsize=(10, 6), dpi=100, layout="constrained")
    rows = figure.subplots(3, 2, sharex=True)
    seconds = torch.arange(len(translation)) / fps
    for column, (found, unit) in enumerate(((translation, "mm along"), (degrees, "° about"))):
        reach = 1.1 * max(float(found.abs().max()), 0.5 if column else 1.0)
        for axis, name in enumerate("xyz"):
            axes = rows[axis][column]
            if true is not None:
                axes.plot(seconds, true[column][:, axis], color=TRUE, linewidth=1.8, alpha=0.8, label="true")
            axes.plot(seconds, found[:, axis], color=SOLVED, linewidth=0.8, label="solved")
            axes.set(ylabel=f"{unit} {name}", ylim=(-reach, reach), xlim=(0, float(seconds[-1])))
            axes.axhline(0, color="grey", linewidth=0.5)
    for axes in rows[-1]:
        axes.set_xlabel("seconds")
    if true is not None:
        rows[0][0].legend(loc="upper right", frameon=False, ncols=2, fontsize=8)
    return from_figure(figure)
