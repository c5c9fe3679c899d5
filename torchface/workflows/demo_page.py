"""The demo's report: what was true, what came back, in pictures, curves and one table."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from torchface.mesh import Mesh
from torchface.rendering.compositing import caption, sheet
from torchface.shape_names import ARKIT, mapping
from torchface.viz.curves import error_curve, named_bars, weight_curves
from torchface.viz.faces import FRONT, THREE_QUARTER, face_views, heat_map
from torchface.viz.markers import marker_views
from torchface.viz.page import Section, Table, write_page
from torchface.workflows.demo import DemoResult

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
    worst = int(weights.mean.argmax())
    names = result.scene.truth.names
    markers = result.recording.take.markers
    assert markers is not None
    seen = torch.isfinite(markers.values).all(-1)
    used = torch.isfinite(weights.correlation)
    return [
        ("frames", f"{len(result.weights)} at {result.scene.fps:g} a second"),
        ("shapes, vertices", f"{len(names)}, {len(result.scene.head.vertices):,}"),
        ("markers, share not seen", f"{seen.shape[1]}, {100 * (1 - float(seen.float().mean())):.1f} %"),
        ("weight error, mean", f"{float(weights.mean.mean()):.4f}"),
        ("weight error, shape with the largest mean", f"{float(weights.mean[worst]):.4f} ({names[worst]})"),
        ("correlation with the true curve, median shape", f"{float(weights.correlation[used].median()):.4f}"),
        ("marker RMSE, median frame", f"{float(result.marker_rmse.nanmedian()):.3f} mm"),
        ("mesh error, mean over face and take", f"{mesh.mean:.3f} mm"),
        ("mesh error as a share of the motion", f"{100 * mesh.relative:.1f} %"),
        ("mesh error, worst vertex and frame", f"{float(mesh.vertex_largest[result.face].max()):.2f} mm")
        if mesh.vertex_largest.shape == result.face.shape
        else ("mesh error, worst vertex and frame", f"{float(mesh.vertex_largest.max()):.2f} mm"),
    ]


def write_demo_page(result: DemoResult, out: Path, progress: Callable[[str], None] | None = None) -> Path:
    """Renders the report of a demo into a folder and returns the page's path."""
    say = progress or (lambda line: None)
    scene = result.scene
    say("rendering the rig")
    rig_picture = _rig_picture(result)
    say("rendering the performance")
    frames = _telling_frames(scene.weights)
    performance = [(f"frame_{frame:05d}.png", _frame_picture(result, frame)) for frame in frames]
    say("drawing curves")
    on_mesh = result.attachment.on(scene.head.faces, result.rig(result.weights[frames]))
    markers = result.recording.take.markers
    assert markers is not None
    sections = [
        Section(
            "What was true and what came back",
            "The take was filmed from the head's true rig; the solver knew only the rig transferred from the template.",
            [Table(("", "value"), result_rows(result)), Table(("exported solver", ""), result.solver.rows())],
        ),
        Section(
            "The rig",
            "Above the template, below the same shapes transferred to the new head.",
            pictures=[("rig.png", rig_picture)],
        ),
        Section(
            "The performance",
            "True face, solved face, and the distance between them in millimetres.",
            pictures=performance,
        ),
        Section(
            "Markers",
            "Seen markers and the points of the solved mesh that stand for them.",
            pictures=[
                (f"markers_{frame:05d}.png", marker_views(markers.values[frame], on_mesh[i], f"frame {frame},"))
                for i, frame in enumerate(frames[:1])
            ]
            + [("marker_rmse.png", error_curve(result.marker_rmse, scene.fps))],
        ),
        Section(
            "Weights",
            pictures=[
                ("weights.png", weight_curves(result.weights, scene.weights, scene.truth.names, scene.fps)),
                ("weight_error.png", named_bars(result.weight_error.mean, scene.truth.names, "mean absolute error")),
            ],
        ),
        Section(
            "Files",
            tables=[Table(("for", "file"), [(purpose, path.name) for purpose, path in result.files.items()])],
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


def _telling_frames(weights: Tensor, count: int = 3) -> list[int]:
    """The frame that moves most, then those that differ most from the frames chosen before."""
    chosen = [int(weights.square().sum(1).argmax())]
    for _ in range(count - 1):  # each choice depends on the one before
        chosen.append(int(torch.cdist(weights, weights[chosen]).amin(1).argmax()))
    return chosen


def _frame_picture(result: DemoResult, frame: int) -> Tensor:
    head = result.scene.head
    true = head.with_vertices(result.scene.truth(result.scene.weights[frame : frame + 1])[0])
    solved = head.with_vertices(result.rig(result.weights[frame : frame + 1].to(result.rig.deltas))[0])
    error = (true.vertices - solved.vertices).norm(dim=1)
    views = (FRONT, THREE_QUARTER)
    row = [
        caption(face_views(true, views, width=240, height=300, framed_by=head), f"true, frame {frame}"),
        caption(face_views(solved, views, width=240, height=300, framed_by=head), "solved"),
    ]
    heat = heat_map(solved, error, 2.0, "mm", width=240, height=300)
    return sheet([sheet(row, 2), heat], 1)
