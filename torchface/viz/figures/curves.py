"""Curves over a take: marker error, sums of weights, single weights (the thesis's figures 58 and 60), and bars."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.rendering.compositing import from_figure, new_figure

__all__ = ["error_curve", "named_bars", "weight_curves"]

SOLVED, TRUE, SINGLE = "#1f5fa8", "#d9822b", "#8e9aa8"
_APART = 1.15  # from one curve of weights to the next


def error_curve(error: Tensor, fps: float, label: str = "marker RMSE (mm)") -> Tensor:
    """An error a frame (T,) over time, with its median; an image (3,H,W).

    Example:
        >>> picture = error_curve(torch.rand(50), fps=25.0)
        >>> bool(picture.min() < 0.5 and picture.max() == 1)  # drawn on white
        True
    """
    figure = new_figure(10, 2.6)
    axes = figure.add_axes((0.08, 0.19, 0.91, 0.78))
    seconds = torch.arange(len(error)) / fps
    axes.plot(seconds, error, color=SOLVED, linewidth=0.8)
    median = float(error.nanmedian())
    axes.axhline(median, color="grey", linewidth=0.8, linestyle="--", label=f"median {median:.3f}")
    axes.set(xlabel="seconds", ylabel=label, ylim=(0, None), xlim=(0, float(seconds[-1])))
    axes.legend(loc="lower right", frameon=False)
    return from_figure(figure)


def timing_curves(values: Tensor, names: Sequence[str], fps: float, label: str) -> Tensor:
    """What each region shows (R,T) over time, beside an even course from the first frame to the last; (3,H,W).

    Example:
        >>> picture = timing_curves(torch.linspace(0, 1, 20)[None] ** 2, ["brow"], fps=30.0, label="share of the way")
        >>> bool(picture.min() < 0.5 and picture.max() == 1)  # drawn on white
        True
    """
    figure = new_figure(10, 4, layout="constrained")
    axes = figure.subplots()
    seconds = torch.arange(values.shape[1]) / fps
    for row, name in zip(values, names, strict=True):
        axes.plot(seconds, row, linewidth=0.9, label=name)
    axes.plot(seconds[[0, -1]], values[0][[0, -1]], color="grey", linewidth=0.8, linestyle="--", label="even")
    axes.set(xlabel="seconds", ylabel=label)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=7)
    return from_figure(figure)


def weight_curves(solved: Tensor, true: Tensor | None, names: Sequence[str], fps: float, max_shapes: int = 6) -> Tensor:
    """The sum of weights over time and the curves of the shapes that move most, solved (T,N) over true; (3,H,W).

    Example:
        >>> solved = torch.rand(30, 2)
        >>> picture = weight_curves(solved, None, ["jawOpen", "mouthPucker"], fps=30.0)
        >>> bool(picture.min() < 0.5 and picture.max() == 1)  # drawn on white
        True
    """
    order = (solved if true is None else true).std(0).argsort(descending=True)[:max_shapes].tolist()
    curves = [("sum of weights", solved.sum(1), None if true is None else true.sum(1))]
    curves += [(names[i], solved[:, i], None if true is None else true[:, i]) for i in order]
    height = 0.55 + 1.1 * len(curves)
    figure = new_figure(10, height)
    # Axes of each curve's own, or a layout that is solved for, would take ten times as long.
    axes = figure.add_axes((0.16, 0.45 / height, 0.83, 1 - 0.55 / height))
    seconds = torch.arange(len(solved)) / fps
    labels = []
    for row, (label, values, truth) in enumerate(curves):
        most = 1.0 if row else max(float(x.max()) for x in (values, truth) if x is not None) or 1.0
        base = -_APART * row
        if truth is not None:
            axes.plot(seconds, base + truth / most, color=TRUE, linewidth=1.6, alpha=0.8, label="" if row else "true")
        axes.plot(seconds, base + values / most, color=SOLVED, linewidth=0.8, label="" if row else "solved")
        labels.append(f"{label}\n0 to {most:.3g}")
    bases = -_APART * torch.arange(len(curves))
    axes.hlines(bases, 0, float(seconds[-1]), color="grey", linewidth=0.5)
    axes.hlines(bases + 1, 0, float(seconds[-1]), color="grey", linewidth=0.5, linestyle=":")
    axes.set_yticks([0.5 - _APART * row for row in range(len(curves))], labels, fontsize=8)
    axes.tick_params(axis="y", length=0)
    axes.set(xlabel="seconds", xlim=(0, float(seconds[-1])), ylim=(0.95 - _APART * len(curves), 1.1))
    axes.legend(loc="upper right", frameon=False, ncols=2, fontsize=8)
    return from_figure(figure)


def compared_curves(
    true: Tensor,
    smooth: Tensor,
    single: Tensor,
    names: Sequence[str],
    fps: float,
    first: int = 0,
    last: int | None = None,
) -> Tensor:
    """True curves (T,N), those of the take solved at once and those of single frames, in two columns; (3,H,W).

    Args:
        true, smooth, single: weights (T,N).
        names: of the shapes, N.
    """
    lines = -(-len(names) // 2)
    figure = new_figure(12, 1.7 * lines, layout="constrained")
    grid = figure.subplots(lines, 2, sharex=True, squeeze=False).flatten()
    stretch = slice(first, last)
    seconds = torch.arange(len(true))[stretch] / fps
    for i, (axes, name) in enumerate(zip(grid, names, strict=False)):
        axes.plot(seconds, single[stretch, i], color=SINGLE, linewidth=0.7, label="frame by frame")
        axes.plot(seconds, true[stretch, i], color=TRUE, linewidth=2.4, alpha=0.85, label="true")
        axes.plot(seconds, smooth[stretch, i], color=SOLVED, linewidth=1.1, label="solved at once")
        axes.set_title(name, fontsize=9, loc="left")
        axes.set(ylim=(0, 1.02), xlim=(float(seconds[0]), float(seconds[-1])))
    for axes in grid[len(names) :]:
        axes.axis("off")
    for axes in grid[-2:]:
        axes.set_xlabel("seconds")
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper right", frameon=False, ncols=3, fontsize=9)
    return from_figure(figure)


def named_bars(values: Tensor, names: Sequence[str], label: str) -> Tensor:
    """One horizontal bar a name, longest on top, for values (N,); (3,H,W).

    Example:
        >>> few, many = (named_bars(torch.rand(n), [f"s{i}" for i in range(n)], "error") for n in (3, 12))
        >>> few.shape[1] < many.shape[1]
        True
    """
    order = values.argsort().tolist()
    figure = new_figure(6, 0.5 + 0.17 * len(order), layout="constrained")
    axes = figure.subplots()
    axes.barh([names[i] for i in order], values[order].tolist(), color=SOLVED)
    axes.tick_params(axis="y", labelsize=7)
    axes.set_xlabel(label)
    axes.margins(y=0.005)
    return from_figure(figure)


def motion_curves(
    translation: Tensor, degrees: Tensor, fps: float, true: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """Translations (T,3), millimetres, and rotations (T,3), degrees, over time, with the true ones if any; (3,H,W)."""
    figure = new_figure(10, 6)
    margins = {"left": 0.08, "right": 0.99, "bottom": 0.08, "top": 0.985, "hspace": 0.1, "wspace": 0.2}
    rows = figure.subplots(3, 2, sharex=True, gridspec_kw=margins)
    seconds = torch.arange(len(translation)) / fps
    for column, (values, unit) in enumerate(((translation, "mm along"), (degrees, "° about"))):
        reach = 1.1 * max(float(values.abs().max()), 0.5 if column else 1.0)
        for axis, name in enumerate("xyz"):
            axes = rows[axis][column]
            if true is not None:
                axes.plot(seconds, true[column][:, axis], color=TRUE, linewidth=1.8, alpha=0.8, label="true")
            axes.plot(seconds, values[:, axis], color=SOLVED, linewidth=0.8, label="solved")
            axes.set(ylabel=f"{unit} {name}", ylim=(-reach, reach), xlim=(0, float(seconds[-1])))
            axes.axhline(0, color="grey", linewidth=0.5)
    for axes in rows[-1]:
        axes.set_xlabel("seconds")
    if true is not None:
        rows[0][0].legend(loc="upper right", frameon=False, ncols=2, fontsize=8)
    return from_figure(figure)
