"""Curves over a take: marker error, sums of weights, single weights (the thesis's figures 58 and 60), and bars."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchface.rendering.compositing import from_figure, new_figure

__all__ = ["error_curve", "named_bars", "weight_curves"]

SOLVED, TRUE, SINGLE = "#1f5fa8", "#d9822b", "#8e9aa8"
_APART, _ROW = 1.15, 1.08  # from one curve of weights to the next, and hundreds of pixels of that


def _legend_above(figure: Any, axes: Any) -> None:
    """A key of what axes show, once each, above all of a figure: within, it lies on curves."""
    handles, names = axes.get_legend_handles_labels()
    shown = dict(zip(names, handles, strict=True))
    figure.legend(shown.values(), shown, loc="outside upper right", frameon=False, ncols=3, fontsize=9)


def plain_log_ticks(axis: Any) -> None:
    """Numbers as people write them on a logarithmic axis: 0.5, 1, 2 and not 5 x 10^-1."""
    from matplotlib.ticker import LogLocator

    axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("{x:g}")


def error_curve(error: Tensor, fps: float, label: str = "marker RMSE (mm)") -> Tensor:
    """An error a frame (T,) over time, with its median; an image (3,H,W).

    Example:
        >>> picture = error_curve(torch.rand(50), fps=25.0)
        >>> bool(picture.min() < 0.5 and picture.max() == 1)  # drawn on white
        True
    """
    figure = new_figure(10, 2.6, layout="constrained")
    axes, seconds, median = figure.subplots(), torch.arange(len(error)) / fps, float(error.nanmedian())
    most = float(error.nan_to_num(0.0).max()) or 1.0
    axes.axhline(median, color="grey", linewidth=0.8, linestyle="--", label=f"median {median:.3f}")
    axes.plot(seconds, error.detach().cpu(), color=SOLVED, linewidth=0.9)
    axes.set(xlabel="seconds", ylabel=label, xlim=(0.0, float(seconds[-1]) or 1.0), ylim=(0.0, 1.05 * most))
    _legend_above(figure, axes)
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
    order = (solved if true is None else true).std(0, correction=0).argsort(descending=True)[:max_shapes].tolist()
    curves = [("sum of weights", solved.sum(1), None if true is None else true.sum(1))]
    curves += [(names[i], solved[:, i], None if true is None else true[:, i]) for i in order]
    figure = new_figure(10, _ROW * len(curves) + 0.55, layout="constrained")
    axes, seconds, ticks = figure.subplots(), torch.arange(len(solved)) / fps, []
    for row, (label, values, truth) in enumerate(curves):
        most = 1.0 if row else max(float(x.max()) for x in (values, truth) if x is not None) or 1.0
        base = -_APART * row
        axes.axhline(base, color="grey", linewidth=0.8)
        axes.axhline(base + 1, color="grey", linewidth=0.8, linestyle="--")
        if truth is not None:
            axes.plot(seconds, base + truth.detach().cpu() / most, color=TRUE, linewidth=2, label="true")
        axes.plot(seconds, base + values.detach().cpu() / most, color=SOLVED, linewidth=0.9, label="solved")
        ticks.append((base + 0.5, f"{label}\n0 to {most:.3g}"))
    axes.set_yticks(*zip(*ticks, strict=True), fontsize=9)
    axes.set(xlabel="seconds", xlim=(0.0, float(seconds[-1]) or 1.0), ylim=(0.95 - _APART * len(curves), 1.1))
    _legend_above(figure, axes)
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
    """True curves (T,N), those of the take solved at once and those of single frames, in two columns; (3,H,W)."""
    lines = -(-len(names) // 2)
    figure = new_figure(12, 1.7 * lines, layout="constrained")
    grid = figure.subplots(lines, 2, sharex=True, squeeze=False).flatten()
    stretch = slice(first, last)
    seconds = torch.arange(len(true))[stretch] / fps
    for i, (axes, name) in enumerate(zip(grid, names, strict=False)):
        axes.plot(seconds, single[stretch, i], color=SINGLE, linewidth=0.7, label="frame by frame")
        axes.plot(seconds, true[stretch, i], color=TRUE, linewidth=2.4, alpha=0.85, label="true")
        axes.plot(seconds, smooth[stretch, i], color=SOLVED, linewidth=1.1, label="whole take")
        axes.set_title(name, fontsize=9, loc="left")
        axes.set(ylim=(0, 1.02), xlim=(float(seconds[0]), float(seconds[-1])))
    for axes in grid[len(names) :]:
        axes.axis("off")
    for axes in grid[-2:]:
        axes.set_xlabel("seconds")
    _legend_above(figure, grid[0])
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


def motion_curves(translation: Tensor, degrees: Tensor, fps: float) -> Tensor:
    """Translations (T,3), millimetres, and rotations (T,3), degrees, over time; (3,H,W)."""
    figure = new_figure(10, 6, layout="constrained")
    grid, seconds = figure.subplots(3, 2, sharex=True), torch.arange(len(translation)) / fps
    for column, (values, unit) in enumerate(((translation, "mm along"), (degrees, "° about"))):
        reach = 1.1 * max(float(values.abs().max()), 0.5 if column else 1.0)
        for axis, name in enumerate("xyz"):
            axes = grid[axis, column]
            axes.axhline(0.0, color="grey", linewidth=0.8)
            axes.plot(seconds, values[:, axis], color=SOLVED, linewidth=0.9)
            axes.set(ylabel=f"{unit} {name}", xlim=(0.0, float(seconds[-1]) or 1.0), ylim=(-reach, reach))
        grid[2, column].set_xlabel("seconds")
    return from_figure(figure)
