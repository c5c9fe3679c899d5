"""Pictures for the cards of priors: how honest the variance is, what is predicted, how settings were chosen."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from torchface.capture.priors import DynamicsPrior, windows_of
from torchface.files.whole_files import make_folder, write_file
from torchface.viz.figures.curves import plain_log_ticks

from .prior_trials import OneStep

_SHOWN = 4
_FRAMES = 240


def calibration_picture(trial: OneStep) -> Figure:
    """Share of frames within k deviations, and the histogram of where the truth fell in what was predicted."""
    figure = _figure(10, 4)
    within, places = figure.subplots(1, 2)
    ks = torch.linspace(0.0, 4.0, 81, dtype=torch.float64)
    normal = torch.distributions.Normal(0.0, 1.0)
    scaled = (trial.errors / trial.deviations).double()
    for values, label in ((scaled, "all weights"), (scaled[trial.changing], "weights that change")):
        share = torch.stack([(values.abs() < k).double().mean() for k in ks])
        within.plot(ks, share, label=label)
    within.plot(ks, 2 * normal.cdf(ks) - 1, "k--", label="a normal distribution")
    within.set(xlabel="standard deviations", ylabel="share of frames within", ylim=(0, 1.02))
    within.grid(alpha=0.3)
    within.legend()
    edges = np.linspace(0, 1, 21)
    for values, label in ((scaled.flatten(), "all weights"), (scaled[trial.changing], "weights that change")):
        places.hist(normal.cdf(-values).numpy(), edges, density=True, histtype="step", linewidth=1.6, label=label)
    places.axhline(1.0, color="k", linestyle="--", label="uniform: a normal distribution")
    places.set(xlabel="probability integral transform of the truth", ylabel="density", xlim=(0, 1))
    places.legend()
    return figure


def curves_picture(prior: DynamicsPrior, take: Tensor) -> Figure:
    """Truth, prediction and two deviations for the shapes that move most, over the liveliest seconds of a take."""
    windows, following = windows_of(take.float(), prior.window)
    step = (following - windows[:, -1]).abs().sum(1)
    span = min(_FRAMES, len(step))
    start = int(step.unfold(0, span, 1).sum(1).argmax())
    rows = slice(start, start + span)
    mean, variance = prior(windows[rows])
    shown = following[rows]
    seconds = torch.arange(len(shown)) / prior.fps
    figure = _figure(11, 7)
    most = shown.std(0).argsort(descending=True)
    groups = torch.tensor([prior.group_index[row] for row in most])
    # One shape a region first, then whatever moves most.
    first = [int(most[(groups == g).nonzero()[0, 0]]) for g in groups.unique()]
    chosen = sorted(first, key=lambda row: -float(shown[:, row].std()))[:_SHOWN]
    for axes, row in zip(figure.subplots(len(chosen), 1, sharex=True, squeeze=False)[:, 0], chosen, strict=True):
        deviation = variance[:, row].sqrt()
        low, high = mean[:, row] - 2 * deviation, mean[:, row] + 2 * deviation
        axes.fill_between(seconds, low, high, alpha=0.3, label="two deviations")
        axes.plot(seconds, mean[:, row], linewidth=1.0, label="predicted")
        axes.plot(seconds, shown[:, row], "k", linewidth=0.8, label="true")
        axes.set(ylabel=prior.names[row])
    axes.set(xlabel="seconds")
    axes.legend(ncols=3)
    return figure


def choice_picture(tables: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]], xlabel: str) -> Figure:
    """Curves of a figure of merit over a setting, a panel a figure: ``{ylabel: {curve: [(x, y), ...]}}``."""
    figure = _figure(5.5 * len(tables), 4)
    for axes, (ylabel, curves) in zip(figure.subplots(1, len(tables), squeeze=False)[0], tables.items(), strict=True):
        for label, points in curves.items():
            axes.plot([x for x, _ in points], [y for _, y in points], "o-", label=label)
        if min(x for points in curves.values() for x, _ in points) > 0 and "window" not in xlabel:
            axes.set_xscale("log")
            plain_log_ticks(axes.xaxis)
        axes.set(xlabel=xlabel, ylabel=ylabel)
        axes.grid(alpha=0.3)
        axes.legend()
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Writes a figure as PNG; the file appears when it is complete."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    make_folder(path.parent)
    write_file(path, content.getvalue())


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure
