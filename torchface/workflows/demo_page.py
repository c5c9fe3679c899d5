"""The demo's report: what was true, what came back, in pictures, curves and one table."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from torchface.mesh import Mesh
from torchface.rendering.compositing import caption, headed, sheet
from torchface.shape_names import ARKIT, mapping
from torchface.viz.curves import error_curve, named_bars, weight_curves
from torchface.viz.faces import FRONT, THREE_QUARTER, face_views, heat_map
from torchface.viz.markers import marker_views
from torchface.viz.page import Section, Table, write_page
from torchface.workflows.demo import FLAWS, DemoResult

_POSES: dict[str, dict[str, float]] = {
    "neutral": {},
    "eyes closed": {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0},
    "smile": {"mouthSmileLeft": 1.0, "mouthSmileRight": 1.0},
    "jaw open": {"jawOpen": 1.0},
    "pucker": {"mouthPucker": 1.0},
}


def result_rows(result: DemoResult) -> list[tuple[str, str]]:
    """The figures of a demo, one a row: what, value."""
    weights, mesh = result.weight_error, result.mesh_error
    names = result.scene.truth.names
    markers = result.recording.take.markers
    assert markers is not None
    sampled = torch.isfinite(markers.values).all(-1).float()
    told = _told_apart(result)
    worst = int(told[weights.mean[told].argmax()])
    curves = weights.correlation[told]
    noise = (3**0.5) * FLAWS.noise
    return [
        ("frames", f"{len(result.weights)} at {result.scene.fps:g} a second"),
        ("shapes, vertices", f"{len(names)}, {len(result.scene.head.vertices):,}"),
        ("markers, share of samples missing", f"{sampled.shape[1]}, {100 * (1 - float(sampled.mean())):.1f} %"),
        ("shapes that these markers tell apart", f"{len(told)}"),
        ("weight error of those, mean", f"{float(weights.mean[told].mean()):.4f}"),
        ("weight error of those, worst", f"{float(weights.mean[worst]):.4f} ({names[worst]})"),
        ("their correlation with the true curve, median", f"{float(curves[torch.isfinite(curves)].median()):.4f}"),
        ("weight error of all shapes, mean", f"{float(weights.mean.mean()):.4f}"),
        ("marker RMSE, median frame", f"{float(result.marker_rmse.nanmedian()):.3f} mm (noise alone: {noise:.2f} mm)"),
        ("mesh error, mean over face and take", f"{mesh.mean:.3f} mm"),
        ("mesh error as a share of the motion", f"{100 * mesh.relative:.1f} %"),
        ("mesh error, worst vertex of any frame", f"{float(mesh.vertex_largest.max()):.2f} mm"),
    ]


def _told_apart(result: DemoResult) -> Tensor:
    """Rows of the shapes that the markers see and do not confuse with others, (K,); all where they confuse all."""
    lost = {*result.seen.unseen, *result.seen.ambiguous}
    told = [i for i, name in enumerate(result.rig.names) if name not in lost]
    return torch.tensor(told or list(range(len(result.rig.names))))


def write_demo_page(result: DemoResult, out: Path, progress: Callable[[str], None] | None = None) -> Path:
    """Renders the report of a demo into a folder and returns the page's path."""
    say = progress or (lambda line: None)
    scene = result.scene
    say("rendering the rig")
    rig_picture = _rig_picture(result)
    say("rendering the performance")
    frames = _telling_frames(result)
    performance = [(f"frame_{i + 1}.png", _frame_picture(result, frame)) for i, frame in enumerate(frames)]
    say("drawing curves")
    on_mesh = result.attachment.on(scene.head.faces, result.rig(result.weights[frames[:1]]))[0]
    markers = result.recording.take.markers
    assert markers is not None
    told = _told_apart(result)
    names = [scene.truth.names[i] for i in told]
    sections = [
        Section(
            "What was true and what came back",
            "The take was filmed from the head's true rig; the solver knew only the rig transferred from the template. "
            f"What no marker can show, no solve can return: {result.seen}.",
            [
                Table(("the solved take", "value"), result_rows(result)),
                Table(("solver.onnx", ""), result.solver.rows()),
            ],
        ),
        Section(
            "The rig",
            "Above the template, below the same shapes transferred to the new head.",
            pictures=[("rig.png", rig_picture)],
        ),
        Section(
            "The performance",
            "Above the true and the solved face, below the distance between them. Eyes that no marker follows stay "
            "where they are.",
            pictures=performance,
        ),
        Section(
            "Markers",
            "Seen markers and the points of the solved mesh that stand for them, then their distance over the take; "
            f"noise alone makes {(3**0.5) * FLAWS.noise:.2f} mm.",
            pictures=[
                ("markers.png", marker_views(markers.values[frames[0]], on_mesh, f"frame {frames[0]},")),
                ("marker_rmse.png", error_curve(result.marker_rmse, scene.fps)),
            ],
        ),
        Section(
            "Weights",
            "The shapes that the markers tell apart: their sum, the curves that move most, the error of each.",
            pictures=[
                ("weights.png", weight_curves(result.weights[:, told], scene.weights[:, told], names, scene.fps)),
                ("weight_error.png", named_bars(result.weight_error.mean[told], names, "mean absolute error")),
            ],
        ),
        Section(
            "Files",
            tables=[Table(("what it is", "file"), [(purpose, path.name) for purpose, path in result.files.items()])],
        ),
    ]
    return write_page(out, scene.title, sections)


def _posed(result: DemoResult, weights: dict[str, float]) -> tuple[Mesh, Mesh]:
    """Template and transferred rig in one pose."""
    arkit = torch.zeros(len(ARKIT))
    for name, value in weights.items():
        arkit[ARKIT.index(name)] = value
    pair = []
    for rig in (result.scene.template, result.rig):
        row = mapping(ARKIT, rig.names) @ arkit
        pair.append(rig.neutral.with_vertices(rig(row[None].to(rig.deltas))[0]))
    return pair[0], pair[1]


def _rig_picture(result: DemoResult) -> Tensor:
    upper, lower = [], []
    for title, weights in _POSES.items():
        template, actor = _posed(result, weights)
        upper.append(
            face_views(template, (THREE_QUARTER,), width=236, height=300, framed_by=result.scene.template.neutral)
        )
        actor_view = face_views(actor, (THREE_QUARTER,), width=236, height=300, framed_by=result.scene.head)
        lower.append(caption(actor_view, title))
    return sheet([*upper, *lower], len(upper))


def _telling_frames(result: DemoResult, count: int = 3) -> list[int]:
    """The frame in which the markers are farthest from rest, then those that differ most from the ones before."""
    moved = result.recording.markers.flatten(1)
    rest = result.attachment.on(result.scene.head.faces, result.scene.truth.vertices).flatten()
    chosen = [int((moved - rest).norm(dim=1).argmax())]
    for _ in range(count - 1):  # each choice depends on the one before
        chosen.append(int(torch.cdist(moved, moved[chosen]).amin(1).argmax()))
    return chosen


def _frame_picture(result: DemoResult, frame: int) -> Tensor:
    head = result.scene.head
    true = head.with_vertices(result.scene.truth(result.scene.weights[frame : frame + 1])[0])
    solved = head.with_vertices(result.rig(result.weights[frame : frame + 1].to(result.rig.deltas))[0])
    error = (true.vertices - solved.vertices).norm(dim=1)
    views = (FRONT, THREE_QUARTER)
    row = [
        headed(face_views(true, views, width=240, height=300, framed_by=head), f"true, frame {frame}"),
        headed(face_views(solved, views, width=240, height=300, framed_by=head), "solved"),
    ]
    heat = heat_map(solved, error, 2.0, "distance, mm", width=240, height=300)
    return sheet([sheet(row, 2), headed(heat, "distance between them")], 1)
