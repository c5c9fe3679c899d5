"""The demo's report: what was true and what came back, as a performance that plays, in figures, curves and tables."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.mesh import Mesh
from torchface.progress import Progress, silent
from torchface.rendering.clay_shading import DEFAULT_LIGHTING
from torchface.rendering.compositing import caption, headed, sheet
from torchface.shape_names import ARKIT, mapping
from torchface.viz.figures.curves import compared_curves, error_curve, named_bars
from torchface.viz.figures.face_views import FRONT, THREE_QUARTER, face_views, heat_map
from torchface.viz.figures.marker_maps import marker_regions, marker_views
from torchface.viz.reports.player import Markers, Panel, Played, Player, write_player
from torchface.viz.reports.report_page import Section, Table, write_page
from torchface.workflows.demo.run_demo import FLAWS, DemoResult, Solved

_POSES: dict[str, dict[str, float]] = {
    "neutral": {},
    "eyes closed": {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0},
    "smile": {"mouthSmileLeft": 1.0, "mouthSmileRight": 1.0},
    "jaw open": {"jawOpen": 1.0},
    "pucker": {"mouthPucker": 1.0},
}
_ACTIVE = 8
_CURVE_SECONDS = 8.0
_HEAT_MAXIMUM = 2.0
# Ten heads in small: few rays show form as well.
_FEW_RAYS = replace(DEFAULT_LIGHTING, occlusion_rays=3)


def result_rows(result: DemoResult) -> list[tuple[str, str, str]]:
    """The figures of a demo, one a row: what, of the take solved at once, frame by frame."""
    names = result.rig.names
    distinct = _distinguishable(result)
    solves = (result.solved, result.frame_by_frame)

    def row(what: str, value: Callable[[Solved], str]) -> tuple[str, str, str]:
        return (what, value(solves[0]), value(solves[1]))

    def worst(solved: Solved) -> str:
        shape = int(distinct[solved.weight_error.mean[distinct].argmax()])
        return f"{float(solved.weight_error.mean[shape]):.3f} ({names[shape]})"

    def median(values: Tensor) -> str:
        return f"{float(values[torch.isfinite(values)].median()):.3f}"

    return [
        row("mesh error, mean over face and take", lambda s: f"{s.mesh_error.mean:.3f} mm"),
        row("mesh error as a share of the motion", lambda s: f"{100 * s.mesh_error.relative:.1f} %"),
        row("mesh error, worst vertex of any frame", lambda s: f"{float(s.mesh_error.vertex_largest.max()):.2f} mm"),
        row("jitter of the curves, times the true ones'", lambda s: f"{s.jitter:.1f}"),
        row("correlation with the true curve, median shape", lambda s: f"{s.correlation:.3f}"),
        row(
            "the same of the shapes that the markers distinguish",
            lambda s: median(s.weight_error.correlation[distinct]),
        ),
        row("weight error, mean", lambda s: f"{float(s.weight_error.mean.mean()):.4f}"),
        row(
            "weight error of the shapes that the markers distinguish, mean",
            lambda s: f"{float(s.weight_error.mean[distinct].mean()):.4f}",
        ),
        row("weight error of those, worst shape", worst),
        row("marker RMSE, median frame", lambda s: f"{float(s.marker_rmse.nanmedian()):.3f} mm"),
    ]


def scene_rows(result: DemoResult) -> list[tuple[str, str]]:
    """What was played, one a row: what, value."""
    markers = result.recording.take.markers
    assert markers is not None
    missing = 1 - float(torch.isfinite(markers.values).all(-1).float().mean())
    scene = result.scene
    return [
        ("frames", f"{len(scene.weights):,} at {scene.fps:g} a second"),
        ("shapes, vertices", f"{len(result.rig.names)}, {len(scene.head.vertices):,}"),
        ("markers, share of samples missing", f"{len(markers.names)}, {100 * missing:.1f} %"),
        ("marker noise, RMSE that it alone makes", f"{FLAWS.noise:g} mm a coordinate, {(3**0.5) * FLAWS.noise:.2f} mm"),
        ("shapes that these markers distinguish", f"{len(_distinguishable(result))} of {len(result.rig.names)}"),
        ("the solve of the whole take", f"{result.seconds:.1f} s"),
    ]


def _distinguishable(result: DemoResult) -> Tensor:
    """Rows of the shapes that the markers see and do not confuse with others, (K,); all where they confuse all."""
    lost = {*result.seen.unseen, *result.seen.ambiguous}
    distinct = [i for i, name in enumerate(result.rig.names) if name not in lost]
    return torch.tensor(distinct or list(range(len(result.rig.names))))


def write_demo_page(result: DemoResult, out: Path, progress: Progress | None = None) -> Path:
    """Renders the report of a demo into a folder and returns the page's path."""
    progress = progress or silent
    scene = result.scene
    names, distinct = result.rig.names, _distinguishable(result)
    shown = _frame_of_figures(result)
    active = scene.weights[:, distinct].std(0).argsort(descending=True)[:_ACTIVE]
    active = distinct[active]
    progress("writing the performance for the page")
    markup = _player(result, out, shown, [names[i] for i in active.tolist()])
    rig_figure = _rig_figure(result, progress)
    progress("drawing one frame")
    frame_figure = _frame_figure(result, shown)
    progress("drawing curves and markers")
    solved, single = result.solved, result.frame_by_frame
    first = _busiest(scene.weights[:, active], round(_CURVE_SECONDS * scene.fps))
    curves = compared_curves(
        scene.weights[:, active],
        solved.weights[:, active],
        single.weights[:, active],
        [names[i] for i in active.tolist()],
        scene.fps,
        first,
        first + round(_CURVE_SECONDS * scene.fps),
    )
    markers = result.recording.take.markers
    assert markers is not None
    on_mesh = result.attachment.on(scene.head.faces, result.rig(solved.weights[shown : shown + 1]))[0]
    sections = [
        Section("The performance", story(result), markup=markup),
        Section(
            "One frame",
            "The true and the solved face, and the distance between them. No marker sits on an eyeball: lids alone "
            "show where eyes look.",
            figures=[("frame_1.png", frame_figure)],
        ),
        Section(
            "How close it came",
            "weights.csv and animation.glb hold the take solved at once; torchface solve --frame-by-frame gives the "
            "other, which trembles with the markers' noise.",
            [
                Table(("against the truth", "whole take", "frame by frame"), result_rows(result)),
                Table(("what was played", ""), scene_rows(result)),
            ],
        ),
        Section(
            "Curves",
            f"{_CURVE_SECONDS:g} s of the {len(active)} most active shapes that the markers distinguish.",
            figures=[("curves.png", curves)],
        ),
        Section(
            "Markers",
            _layout_text(result),
            [Table(("the markers", "shapes"), _seen_rows(result))],
            _layout_figures(result),
        ),
        Section(
            "Markers against the solved face",
            f"Their distance; noise alone makes {(3**0.5) * FLAWS.noise:.2f} mm.",
            figures=[
                ("markers.png", marker_views(markers.values[shown], on_mesh, f"frame {shown},")),
                ("marker_rmse.png", error_curve(solved.marker_rmse, scene.fps)),
            ],
        ),
        Section(
            "The rig",
            "Above the template, below the same shapes transferred to the new head.",
            figures=[("rig.png", rig_figure)],
        ),
        Section(
            "Error of each shape",
            "Of the shapes that the markers distinguish.",
            figures=[
                (
                    "weight_error.png",
                    named_bars(solved.weight_error.mean[distinct], [names[i] for i in distinct], "mean absolute error"),
                )
            ],
        ),
        Section(
            "Files",
            tables=[
                Table(("what it is", "file"), [(purpose, path.name) for purpose, path in result.files.items()]),
                Table(("solver.onnx", ""), result.solver.rows()),
            ],
        ),
    ]
    return write_page(out, scene.title, sections)


def story(result: DemoResult) -> str:
    """The demo in one sentence."""
    mesh, markers = result.solved.mesh_error, len(result.attachment.triangles)
    length = len(result.scene.weights) / result.scene.fps
    return (
        f"A head that nobody had rigged was given the template's {len(result.rig.names)} shapes and {markers} markers, "
        f"and what it played in {length:.0f} s came back from the noisy markers, gaps and all, on average "
        f"{mesh.mean:.2f} mm from the truth: {100 * mesh.relative:.0f} % of how far the face moved."
    )


def _player(result: DemoResult, out: Path, start: int, curves: Sequence[str]) -> str:
    markers = result.recording.take.markers
    assert markers is not None
    scene = result.scene
    takes = [
        Played("true", scene.truth, scene.weights),
        Played("whole take", result.rig, result.solved.weights),
        Played("frame by frame", result.rig, result.frame_by_frame.weights),
    ]
    panels = [Panel("true, with its markers", 0, markers=True), Panel("solved"), Panel("distance", error=True)]
    captured = Markers(markers.select(result.attachment.labels or ()).values)
    return write_player(Player(takes, panels, scene.fps, (1, 2), 0, curves, captured, _HEAT_MAXIMUM, start), out)


def _layout_text(result: DemoResult) -> str:
    if result.layout is None:
        return "Spread over the skin that moves: the rig has neither 68 landmarks nor ARKit's names to go by."
    return "Set by muscles, as a make-up artist sets them for facial action coding; attachment.json has their names."


def _layout_figures(result: DemoResult) -> list[tuple[str, Tensor]]:
    points = result.attachment.on(result.scene.head.faces, result.scene.truth.vertices)
    regions = ("markers",) * len(points) if result.layout is None else result.layout.regions
    return [("layout.png", marker_regions(result.scene.head, points, regions))]


def _seen_rows(result: DemoResult) -> list[tuple[str, str]]:
    """What the markers see, what they mix up, what they do not see."""
    seen = result.seen
    distinct = [name for name in result.rig.names if name not in {*seen.unseen, *seen.ambiguous}]
    rows = [("distinguish", distinct), ("confuse with others", seen.ambiguous), ("do not see", seen.unseen)]
    return [(what, f"{len(shapes)}: {_both_sides(shapes)}") for what, shapes in rows if shapes]


def _both_sides(names: Sequence[str]) -> str:
    """Names in a row, those of both sides once."""
    short = []
    for name in names:
        bare = name
        for left, right in (("Left", "Right"), ("_L", "_R")):
            for side, other in ((left, right), (right, left)):
                if name.endswith(side) and name.removesuffix(side) + other in names:
                    bare = name.removesuffix(side)
        bare = name if bare.islower() else bare  # mouthLeft is no side of a shape called mouth
        if bare not in short:
            short.append(bare)
    return ", ".join(short)


def _busiest(weights: Tensor, frames: int) -> int:
    """Where a window of so many frames begins in which the weights (T,N) vary most."""
    if len(weights) <= frames:
        return 0
    return int(weights.unfold(0, frames, 1).std(-1).sum(1).argmax())


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


def _rig_figure(result: DemoResult, progress: Progress) -> Tensor:
    upper, lower = list[Tensor](), list[Tensor]()
    for title, weights in _POSES.items():
        progress("rendering the rig", len(upper), len(_POSES))
        template, actor = _posed(result, weights)
        upper.append(
            face_views(
                template,
                (THREE_QUARTER,),
                width=236,
                height=300,
                framed_by=result.scene.template.neutral,
                lighting=_FEW_RAYS,
            )
        )
        actor_view = face_views(
            actor, (THREE_QUARTER,), width=236, height=300, framed_by=result.scene.head, lighting=_FEW_RAYS
        )
        lower.append(caption(actor_view, title))
    return sheet([*upper, *lower], len(upper))


def _frame_of_figures(result: DemoResult) -> int:
    """The frame in which the markers are farthest from rest."""
    rest = result.attachment.on(result.scene.head.faces, result.scene.truth.vertices).flatten()
    return int((result.recording.markers.flatten(1) - rest).norm(dim=1).argmax())


def _frame_figure(result: DemoResult, frame: int) -> Tensor:
    head = result.scene.head
    true = head.with_vertices(result.scene.truth(result.scene.weights[frame : frame + 1])[0])
    solved = head.with_vertices(result.rig(result.solved.weights[frame : frame + 1].to(result.rig.deltas))[0])
    error = (true.vertices - solved.vertices).norm(dim=1)
    views = (FRONT, THREE_QUARTER)
    row = [
        headed(face_views(true, views, width=240, height=300, framed_by=head), f"true, frame {frame}"),
        headed(face_views(solved, views, width=240, height=300, framed_by=head), "solved"),
    ]
    heat = heat_map(solved, error, _HEAT_MAXIMUM, "distance, mm", width=240, height=300)
    return sheet([sheet(row, 2), headed(heat, "distance between them")], 1)
