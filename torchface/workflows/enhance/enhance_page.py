"""The report of an enhanced animation: frames side by side, curvature, what was added, what the model did not know."""

from pathlib import Path

import torch
from torch import Tensor

from torchface.escaped_text import as_markup
from torchface.rendering.compositing import from_figure, new_figure
from torchface.viz.figures.curves import timing_curves
from torchface.viz.reports.report_page import Section, Table, write_page
from torchface.workflows.enhance.enhance_animation import Enhanced, spread_frames
from torchface.workflows.enhance.enhance_views import added_views, compared_frames, curvature_views, shown_frame

_SHOWN = 4
_HEIGHT = 380


def write_enhance_page(done: Enhanced, out: Path, height: int = _HEIGHT) -> Path:
    """Writes the report's page and figures into a folder; the page's path."""
    shown = [shown_frame(done.animation, done.model, done.frames, t) for t in spread_frames(done, _SHOWN)]
    files = ", ".join(f"{what}: {path.name}" for what, path in done.products.items())
    sections = [
        Section("What was done", "\n".join([*done.lines(), f"files: {files}"])),
        Section(
            "Frames",
            "The input as its file has it, its low frequencies on the model's mesh, and those with the model's detail; "
            "the head is held still.",
            figures=[("frames.png", compared_frames(shown, done.animation, done.mesh, height))],
            markup=_player(done),
        ),
        Section(
            "Mean curvature",
            "Folds are blue, ridges red; the scale ends at 0.1 mm⁻¹. Waves of 8 mm are shown at half, pores hardly.",
            figures=[("curvature.png", curvature_views(shown, done.mesh, height))],
        ),
        Section(
            "What was added",
            "Distance of the enhanced vertices from the smooth ones.",
            figures=[("added.png", added_views(shown, done.mesh, height))],
        ),
        Section(
            "How near the database comes",
            "Distance of each frame from the model's frames, by region, relative to how these differ among one "
            f"another. {done.outside_share:.0%} of the frames are outside in some region, further away than twice what "
            "the model's own sequences are from each other: there detail is a guess, and far away but the nearest.",
            [_regions(done)],
            [("distances.png", distance_curves(done))],
        ),
    ]
    moments, fps = done.animation.moments, done.animation.fps
    if moments is not None:
        text = "Which moment of the input each region shows; between the keyframes the course is the actor's."
        figure = timing_curves(moments / fps, done.model.regions.names, fps, "moment of the input (s)")
        sections.insert(2, Section("Timing", text, figures=[("timing.png", figure)]))
    return write_page(out, f"{done.animation.path.name} enhanced", sections)


def distance_curves(done: Enhanced) -> Tensor:
    """The distance of every region over time, those outside of the database marked; an image (3,H,W)."""
    figure = new_figure(10, 3.4, layout="constrained")
    axes = figure.subplots()
    seconds = torch.arange(done.animation.count) / done.animation.fps
    distances, outside = done.frames.distances, done.frames.outside
    for number, name in enumerate(done.model.regions.names):
        line = axes.plot(seconds, distances[:, number], linewidth=0.9, label=name)[0]
        away = outside[:, number]
        axes.plot(seconds[away], distances[away, number], ".", color=line.get_color(), markersize=3)
    axes.set(xlabel="seconds", ylabel="distance", ylim=(0, None), xlim=(0, max(float(seconds[-1]), 1e-3)))
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=7)
    return from_figure(figure)


def _regions(done: Enhanced) -> Table:
    distances, outside = done.frames.distances, done.frames.outside.float().mean(0)
    rows = [
        (
            name,
            f"{float(distances[:, i].median()):.3f}",
            f"{float(distances[:, i].quantile(0.95)):.3f}",
            f"{done.model.limits[i]:.3f}",
            f"{float(outside[i]):.1%}",
        )
        for i, name in enumerate(done.model.regions.names)
    ]
    return Table(("region", "median distance", "95 %", "outside from", "frames outside"), rows)


def _player(done: Enhanced) -> str:
    """The video where there is one."""
    if "video" not in done.products:
        return ""
    name = as_markup(done.products["video"].name)
    return f'<video src="{name}" controls loop muted style="max-width: 100%"></video>\n'
