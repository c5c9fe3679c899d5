"""Report of a tracked video: figures, frames with the solved face beside and over them, curves."""

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchface.escaped_text import as_markup
from torchface.evaluation import weight_jitter
from torchface.rendering.compositing import caption, sheet
from torchface.viz.figures.curves import error_curve, motion_curves, weight_curves
from torchface.viz.reports.report_page import Section, Table, write_page
from torchface.workflows.head_rotations import head_angles
from torchface.workflows.track.frame_readings import shown_frames
from torchface.workflows.track.overlay_video import camera_at, mesh_drawer, side_by_side_drawer
from torchface.workflows.track.track_result import MIN_STABLE, Tracked

_COLUMNS, _WIDTH = 4, 300
_CURVES_A_PICTURE = 13
_MARGIN = 0.6


def write_track_page(tracked: Tracked, out: Path) -> Path:
    """Writes the report's page and figures into a folder, and returns the page's path."""
    fps, solution = tracked.video.fps, tracked.solution
    files = ", ".join(f"{name}: {path.name}" for name, path in tracked.products.items())
    beside, over = frames_sheets(tracked, [(side_by_side_drawer(tracked), False), (mesh_drawer(tracked), True)])
    sections = [
        Section("What was done", "\n".join([*tracked.lines(), f"files: {files}"])),
        Section("Figures", tables=[Table(("figure", "value"), figures(tracked))]),
        Section(
            "Frames",
            "The picture and, beside it, the solved rig in the same pose; landmarks are green, those of low confidence "
            "orange, those taken for hidden are left out; what of the rig lies at either is orange.",
            [_suspect(tracked)],
            [("frames.png", beside)],
            _player(tracked),
        ),
        Section(
            "Landmarks over the picture",
            "The solved face half through over the video; found landmarks are green, those of the solved rig red.",
            figures=[("landmarks.png", over)],
        ),
        Section(
            "Reprojection error",
            "Root mean square distance from the landmarks found to those of the solved rig, a frame; gaps are frames "
            "without a face.",
            figures=[("error.png", error_curve(solution.errors.detach(), fps, "error (px)"))],
        ),
    ]
    angles = torch.rad2deg(head_angles(solution.rotation.detach().double()))
    moved = solution.translation.detach().double()
    still = moved - moved.mean(0)
    # Turns as the plot has them: about x, y and z.
    head = motion_curves(still.float(), angles[:, [1, 0, 2]].float(), fps)
    text = (
        "Where the head is before the camera, about its mean place (x right, y down, z away from the camera), and how "
        "it is rotated: pitch about x, yaw about y, roll about z."
    )
    sections.append(Section("Head", text, figures=[("pose.png", head)]))
    weights, names = solution.weights.detach(), tracked.rig.names
    order = weights.amax(0).argsort(descending=True).tolist()
    curves = []
    for number, first in enumerate(range(0, len(order), _CURVES_A_PICTURE)):
        rows = order[first : first + _CURVES_A_PICTURE]
        curve = weight_curves(weights[:, rows], None, [names[i] for i in rows], fps, len(rows))
        curves.append((f"weights{number + 1}.png", curve))
    sections.append(Section("Weights", "Every shape's curve, the strongest first.", [_bounds(tracked)], curves))
    return write_page(out, f"Tracking of {tracked.video.path.name}", sections)


def figures(tracked: Tracked) -> list[tuple[str, str]]:
    """Names and numbers for a table."""
    errors, count = tracked.solution.errors.detach(), len(tracked)
    seen, camera = tracked.seen, tracked.calibration
    few = int((seen & (tracked.stable < MIN_STABLE)).sum())
    weights = tracked.solution.weights.detach()
    rows = [
        ("frames", str(count)),
        ("landmarks found by", tracked.finder),
        ("frames with a face", f"{100 * float(seen.float().mean()):.1f} %"),
        ("frames with fewer than six stable landmarks", str(few)),
        ("jitter of the landmarks", f"{tracked.jitter:.2f} px"),
        ("jitter of the weights", f"{weight_jitter(weights):.4f}"),
        ("reprojection error, median", f"{float(errors.nanmedian()):.2f} px"),
        ("reprojection error, 95th percentile", f"{float(errors.nanquantile(0.95)):.2f} px"),
        ("weights at 0", f"{100 * float((weights <= 1e-3).float().mean()):.0f} %"),
        ("weights at 1", f"{100 * float((weights >= 1 - 1e-3).float().mean()):.1f} %"),
        ("camera", tracked.camera_source),
        ("focal length", f"{float(camera.intrinsics[0, 0]):.0f} px"),
        ("faces in the first frame", str(tracked.faces)),
    ]
    rows += [(f"{name}, time with its start", f"{took:.1f} s") for name, took in tracked.seconds.items()]
    return rows


def frames_sheets(tracked: Tracked, drawers: Sequence[tuple[Callable[[int, Tensor], Tensor], bool]]) -> list[Tensor]:
    """Sheets of frames spread over the video, read once, as each of ``drawers`` makes frame number t, (3,H,W); cut to
    the face where it says so."""
    wanted = shown_frames(len(tracked))
    cells: list[list[Tensor]] = [[] for _ in drawers]
    face = _face_box(tracked, wanted)
    known = all(t in tracked.pictures for t in wanted)
    for t, frame in sorted(tracked.pictures.items()) if known else enumerate(tracked.video.color_frames()):
        if t not in wanted:
            continue
        for made, (draw, cut) in zip(cells, drawers, strict=True):
            made.append(caption(_cut(draw(t, frame), face if cut else None), f"frame {t}", 12))
    return [sheet(made, min(_COLUMNS, len(made))) for made in cells]


def _face_box(tracked: Tracked, frames: list[int]) -> tuple[int, int, int, int]:
    """A part of the image, x0, y0, x1, y1, that holds the head in these frames."""
    marks = tracked.rig.neutral.landmarks
    weights = tracked.solution.weights.detach().to(tracked.rig.deltas)
    pixels = torch.cat([camera_at(tracked, t).project(tracked.rig(weights[t : t + 1])[0, marks].double())
                        for t in frames])  # fmt: skip
    low, high = pixels.amin(0), pixels.amax(0)
    border = _MARGIN * float((high - low).max())
    video = tracked.video
    x0, y0 = max(0, int(low[0] - border)), max(0, int(low[1] - border))
    x1, y1 = min(video.width, int(high[0] + border) + 1), min(video.height, int(high[1] + border) + 1)
    return (x0, y0, x1, y1) if x1 - x0 > 8 and y1 - y0 > 8 else (0, 0, video.width, video.height)


def _cut(image: Tensor, box: tuple[int, int, int, int] | None) -> Tensor:
    """A part of a picture, uint8 (3,H,W), as wide as a cell, in [0,1]."""
    x0, y0, x1, y1 = box or (0, 0, image.shape[2], image.shape[1])
    part = image[:, y0:y1, x0:x1]
    scale = _WIDTH / part.shape[2]
    size = (max(1, round(part.shape[1] * scale)), _WIDTH)
    small = torch.nn.functional.interpolate(part[None].contiguous(), size, mode="bilinear", antialias=True)
    return small[0].float() / 255


def _player(tracked: Tracked) -> str:
    """The overlay video where there is one."""
    name = tracked.products["overlay"].name if "overlay" in tracked.products else ""
    return f'<video src="{as_markup(name)}" controls loop muted style="max-width: 100%"></video>\n' if name else ""


def _suspect(tracked: Tracked) -> Table:
    spans = tracked.suspect_spans()
    rows = [
        (f"{first} to {last}", f"{tracked.seconds_at(first):.2f} to {tracked.seconds_at(last):.2f} s", what)
        for first, last, what in spans
    ]
    return Table(("frames", "time", "what is suspect"), rows or [("none", "", "")])


def _bounds(tracked: Tracked) -> Table:
    share = tracked.bounds()
    rows = [
        (tracked.rig.names[i], f"{100 * float(share[i]):.0f} %")
        for i in share.argsort(descending=True).tolist()
        if share[i] > 0
    ]
    return Table(("at its bound of 1", "frames"), rows or [("none", "")])
