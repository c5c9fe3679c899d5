"""The report of a solve: every weight's curve, marker error, the helmet's motion, what was wrong with the take."""

from __future__ import annotations

from pathlib import Path

from torchface.viz.curves import error_curve, weight_curves
from torchface.viz.motion import motion_curves
from torchface.viz.page import Section, Table, write_page
from torchface.workflows.solve import SolveReport

_CURVES_A_PICTURE = 13
_MOST_ROWS = 400


def write_solve_page(folder: Path, title: str, report: SolveReport) -> Path:
    """Writes the report's page and pictures into a folder.

    Returns:
        The page's path.
    """
    take = report.take
    assert take.weights is not None
    weights, names = take.weights.values[..., 0], take.weights.names
    sections = [Section("What was done", "; ".join(line for line in report.lines() if not line.startswith("  ")))]
    sections.append(Section("Marker error", pictures=[("error.png", error_curve(report.rmse, take.fps))]))
    if report.motion is not None:
        curves = motion_curves(report.motion.translation, report.motion.degrees(), take.fps)
        text = "How the helmet moved against the head, in rig space; none of it is in the weights."
        sections.append(Section("Helmet", text, pictures=[("helmet.png", curves)]))
    if report.cleanup is not None:
        heading = ("what", "markers", "frames", "off by", "done")
        rows = report.cleanup.table()[:_MOST_ROWS]
        tables = [Table(heading, rows)] if rows else []
        sections.append(Section("What was wrong with the take", report.cleanup.summary(), tables))
    order = weights.amax(0).argsort(descending=True).tolist()
    pictures = []
    for number, first in enumerate(range(0, len(order), _CURVES_A_PICTURE)):
        rows_of_page = order[first : first + _CURVES_A_PICTURE]
        part = weights[:, rows_of_page]
        label = [names[i] for i in rows_of_page]
        pictures.append((f"weights{number + 1}.png", weight_curves(part, None, label, take.fps, len(label))))
    sections.append(Section("Weights", "Every shape's curve, the strongest first.", pictures=pictures))
    return write_page(folder, f"Solve of {title}", sections)
