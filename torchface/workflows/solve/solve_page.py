"""The page of a solve: the face as it plays, marker errors on it and in a table, what was wrong, every curve."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.markers import Cleanup, Defect
from torchface.files.whole_files import make_folder
from torchface.rendering.clay_shading import DEFAULT_LIGHTING, render
from torchface.rendering.compositing import caption, sheet
from torchface.rig import BlendshapeRig
from torchface.viz import error_curve, frame_face, marker_map, weight_curves
from torchface.viz.figures.curves import motion_curves
from torchface.viz.figures.error_maps import round_maximum
from torchface.viz.figures.region_colors import as_seen
from torchface.viz.reports.player import Markers, Panel, Played, Player, write_player
from torchface.viz.reports.report_page import Section, Table, write_page
from torchface.workflows.solve.solution import Solution, SolveReport

_CURVES_A_FIGURE = 13
_ACTIVE, _SHOWN_FRAMES, _SIDE = 8, 8, 55.0
_WORST_MARKERS = 12
_KINDS = {
    "swap": "Swapped labels",
    "displaced": "Markers that drift, fell off or carry another's label",
    "spike": "Spikes",
}
_HEADING = ("markers", "frames", "seconds", "distance", "done")
_MAX_ROWS = 60


def write_solve_page(folder: Path, title: str, report: SolveReport) -> Path:
    """Writes the report's page and figures into a folder, made if absent; the page's path."""
    solution = report.solution
    fps, weights = solution.take.fps, solution.weights.float()
    shown = solution.take.even_rows()
    make_folder(folder)
    done = "\n".join(line for line in report.lines() if not line.startswith(("  ", "warning:")))
    sections = [
        Section(
            "The performance",
            "The solved face with the markers as the solve used them, coloured by their distance from their sites.",
            figures=[("frames.png", _strip(solution.rig, weights, solution.take.numbers[shown].tolist()))],
            markup=_player(folder, solution),
        ),
        Section("What was done", done),
        *_marker_sections(solution),
    ]
    if report.warnings:
        sections.insert(0, Section("Warnings", "; ".join(report.warnings)))
    if solution.cleanup is not None:
        sections.append(_defects(solution.cleanup, fps))
    if solution.motion is not None:
        curves = motion_curves(solution.motion.translation[shown], solution.motion.degrees()[shown], fps)
        text = "How the helmet moved against the head, in rig space; none of it is in the weights."
        sections.append(Section("Helmet", text, figures=[("helmet.png", curves)]))
    order = weights.amax(0).argsort(descending=True).tolist()
    figures = []
    for number, first in enumerate(range(0, len(order), _CURVES_A_FIGURE), start=1):
        rows = order[first : first + _CURVES_A_FIGURE]
        names = [solution.rig.names[i] for i in rows]
        figures.append((f"weights{number}.png", weight_curves(weights[shown][:, rows], None, names, fps, len(names))))
    sections.append(Section("Weights", "Every shape's curve, the strongest first.", figures=figures))
    return write_page(folder, f"Solve of {title}", sections)


def _player(folder: Path, solution: Solution) -> str:
    rows = solution.take.even_rows()
    rig, weights = solution.rig, solution.weights.float()[rows]
    errors = solution.offsets.norm(dim=-1)[rows]
    active = weights.std(0, correction=0).argsort(descending=True)[:_ACTIVE].tolist()
    markers = Markers(solution.markers.float()[rows], errors, _scale(errors))
    panels = [Panel("solved", 0, markers=True), Panel("from the side", 0, markers=True, yaw=_SIDE)]
    curves = tuple(rig.names[i] for i in active)
    played = Played("solved", rig, weights)
    return write_player(Player([played], panels, solution.take.fps, curves=curves, markers=markers), folder)


def _scale(errors: Tensor) -> float:
    """Where the colours of marker errors end: such that the best half stays below their middle."""
    known = errors[torch.isfinite(errors)]
    return round_maximum(2 * float(known.median())) if len(known) else 1.0


def _strip(rig: BlendshapeRig, weights: Tensor, numbers: Sequence[int]) -> Tensor:
    """The frames that differ most from each other, with their numbers, in the order of time, (3,H,W)."""
    chosen = [int((weights.square().sum(1)).argmax())]
    while len(chosen) < min(_SHOWN_FRAMES, len(weights)):  # each choice depends on the one before
        chosen.append(int(torch.cdist(weights, weights[chosen]).amin(1).argmax()))
    camera = frame_face(rig.neutral, width=150, height=188)
    lighting, seen = replace(DEFAULT_LIGHTING, occlusion_rays=4), as_seen(rig.neutral)

    def image(frame: int) -> Tensor:
        moved = rig(weights[frame : frame + 1].to(rig.deltas))[0]
        return caption(render(seen.with_vertices(moved), camera, lighting=lighting), f"frame {numbers[frame]}", 12)

    return sheet([image(frame) for frame in sorted(set(chosen))], _SHOWN_FRAMES)


def _marker_sections(solution: Solution) -> list[Section]:
    rig, labels, offsets = solution.rig, solution.attachment.labels or (), solution.offsets
    errors = offsets.norm(dim=-1)
    each = errors.square().nanmean(0).sqrt()
    bias = offsets.nanmean(0).norm(dim=-1)
    high = errors.double().nanquantile(0.95, dim=0)
    seen = torch.isfinite(errors).float().mean(0)
    order = each.nan_to_num(-1.0).argsort(descending=True).tolist()
    rows = [
        (labels[i], *(f"{float(value[i]):.2f} mm" for value in (each, bias, high)), f"{100 * float(seen[i]):.1f} %")
        for i in order
    ]
    heading = ("marker", "RMSE", "constant part", "95th percentile", "seen")
    points = solution.attachment.on(rig.neutral.faces, rig.vertices)
    figure = marker_map(rig.neutral, points, each, round_maximum(1.5 * float(each.nanmedian())), labels)
    over_time = solution.rmse[solution.take.even_rows()]
    text = (
        "Worst first. A constant part that makes up most of an error speaks of a site that is wrong (see torchface "
        "attach), the rest of noise, swaps and shapes that the rig lacks."
    )
    tables = [Table(heading, rows[:_WORST_MARKERS])]
    if len(rows) > _WORST_MARKERS:
        tables.append(Table(heading, rows[_WORST_MARKERS:], f"the other {len(rows) - _WORST_MARKERS} markers"))
    return [
        Section("Error of each marker", text, tables, [("marker_map.png", figure)]),
        Section("Marker error over time", figures=[("error.png", error_curve(over_time, solution.take.fps))]),
    ]


def _defects(cleanup: Cleanup, fps: float) -> Section:
    """What was wrong by kind, swaps first; gaps, of which there may be hundreds, a marker a row."""
    tables = []
    for kind, title in _KINDS.items():
        defects = sorted((d for d in cleanup.defects if d.kind == kind), key=lambda d: -d.size)
        rows = [_row(cleanup, defect, fps) for defect in defects]
        if rows:
            tables.append(Table((title, *_HEADING[1:]), rows[:_MAX_ROWS]))
        if len(rows) > _MAX_ROWS:
            tables.append(Table(_HEADING, rows[_MAX_ROWS:], f"{len(rows) - _MAX_ROWS} more of them"))
    gaps = [defect for defect in cleanup.defects if defect.kind == "gap"]
    if gaps:
        filled = sum(defect.action == "filled" for defect in gaps)
        summary = f"{len(gaps)} gaps, {filled} of them filled, by marker"
        tables.append(Table(("gaps of", "how many", "frames", "longest"), _gap_rows(gaps, fps), summary))
    return Section("What was wrong with the take", cleanup.summary(), tables)


def _row(cleanup: Cleanup, defect: Defect, fps: float) -> tuple[str, ...]:
    return (
        " ↔ ".join(defect.labels),
        cleanup.span(defect),
        f"{defect.first / fps:.2f}",
        f"{defect.size:.1f} mm",
        defect.action,
    )


def _gap_rows(gaps: Sequence[Defect], fps: float) -> list[tuple[str, ...]]:
    """A marker a row: how many gaps, frames in them, the longest in seconds; most frames first."""
    lengths: dict[str, list[int]] = {}
    for gap in gaps:
        lengths.setdefault(gap.labels[0], []).append(gap.last - gap.first + 1)
    order = sorted(lengths, key=lambda label: -sum(lengths[label]))
    return [
        (label, str(len(lengths[label])), str(sum(lengths[label])), f"{max(lengths[label]) / fps:.2f} s")
        for label in order
    ]
