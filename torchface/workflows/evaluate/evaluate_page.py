"""The report of an evaluation: figures by region and by shape, error over time, heat maps."""

from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from torchface.viz.figures.curves import error_curve, named_bars
from torchface.viz.figures.error_maps import GREEN_TO_RED, compared_views, error_views
from torchface.viz.reports.report_page import Section, Table, write_page
from torchface.workflows.evaluate.evaluation_record import Compared, Evaluation

_RATE = 30.0


def write_evaluation_page(evaluation: Evaluation, out: Path, height: int = 290) -> Path:
    """Writes the report's page and figures into a folder; the page's path."""
    sections = [Section("What was compared", "; ".join(evaluation.lines()))]
    heading = ("region", "mean", "median", "95 %", "largest", "total", "vertices")
    rows = [
        (name, *(f"{value:.3f}" for value in figures[:5]), str(figures[5]))
        for name, figures in ((name, tuple(asdict(found).values())) for name, found in evaluation.regions.items())
    ]
    text = "Distances from vertex to true vertex, millimetres; the total is the sum over a frame's vertices."
    sections.append(Section("By region", text, [Table(heading, rows)]))
    sections.append(Section("Heat maps", _scale_text(evaluation), figures=_heat_maps(evaluation, height)))
    if len(evaluation.frames) > 1:
        curve = error_curve(evaluation.frame_mean, evaluation.fps or _RATE, "mean error (mm)")
        text = "" if evaluation.fps else f"No frame rate is known; {_RATE:g} a second are assumed."
        sections.append(Section("Error over time", text, figures=[("frames.png", curve)]))
    if evaluation.aligned and evaluation.rotation is not None and evaluation.translation is not None:
        rotation, translation = evaluation.rotation, evaluation.translation
        sections.append(
            Section(
                "Alignment",
                f"Each frame was aligned rigidly with the truth: rotated by {float(rotation.nanmedian()):.2f} degrees "
                f"and moved by {float(translation.nanmedian()):.2f} mm in the median, by at most "
                f"{float(rotation.nan_to_num().max()):.2f} degrees and {float(translation.nan_to_num().max()):.2f} mm.",
            )
        )
    sections.extend(_shapes(evaluation))
    return write_page(out, f"{evaluation.result} against {evaluation.truth}", sections)


def _scale_text(evaluation: Evaluation) -> str:
    return (
        f"Green is no error, red {evaluation.maximum:g} mm or more (colour map {GREEN_TO_RED}); grey was not compared."
    )


def _heat_maps(evaluation: Evaluation, height: int) -> list[tuple[str, Tensor]]:
    maximum = evaluation.maximum
    compared = int(torch.isfinite(evaluation.frame_mean).sum())
    title = f"mean over {compared} frames"
    figures = []
    if len(evaluation.frames) > 1:
        figures.append(("heat_mean.png", error_views(evaluation.mesh, evaluation.vertex_mean, maximum, title, height)))
    for shown in evaluation.shown:
        name = f"heat_frame_{shown.frame}.png"
        figures.append((name, _one_frame(evaluation, shown, height)))
    return figures


def _one_frame(evaluation: Evaluation, shown: Compared, height: int) -> Tensor:
    mean = float(shown.errors.nanmean())
    known = torch.isfinite(shown.true).all(1, keepdim=True) & torch.isfinite(shown.found).all(1, keepdim=True)
    # Where the truth has no vertex the result's stands in, so that the figure has a whole face; it is grey below.
    vertices = torch.where(torch.isfinite(shown.found), shown.found, evaluation.mesh.vertices)
    true = torch.where(known, shown.true, vertices)
    title = f"frame {shown.frame}: mean {mean:.2f} mm, total {float(shown.errors.nansum()):.2f} mm"
    own = evaluation.mesh
    return compared_views(
        own.with_vertices(vertices), own.with_vertices(true), shown.errors, evaluation.maximum, title, height
    )


def _shapes(evaluation: Evaluation) -> list[Section]:
    if evaluation.shapes is None:
        return []
    shapes = evaluation.shapes
    order = shapes.error.mean.argsort(descending=True).tolist()
    rows = [
        (
            shapes.names[i],
            f"{float(shapes.error.mean[i]):.4f}",
            f"{float(shapes.error.largest[i]):.3f}",
            "" if bool(shapes.error.correlation[i].isnan()) else f"{float(shapes.error.correlation[i]):.3f}",
        )
        for i in order
    ]
    missing = f" The result has nothing for {', '.join(shapes.missing)}." if shapes.missing else ""
    text = f"Weights against true weights over {shapes.frames} frames.{missing}"
    table = Table(("shape", "mean error", "largest", "correlation"), rows)
    bars = ("shapes.png", named_bars(shapes.error.mean, shapes.names, "mean error of the weight"))
    return [Section("By shape", text, [table], [bars])]
