"""From a rig, a marker take and an attachment on disk to weights on disk."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture import MarkerSolver
from torchface.errors import ValueRangeError
from torchface.evaluation import marker_rmse
from torchface.geometry.alignment import Similarity, similarity_transform
from torchface.io import load_rig, load_take, save_animation
from torchface.io.live_link import save_live_link
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track, require_seen


@dataclass(frozen=True, eq=False)
class SolveReport:
    """What a solve did.

    Args:
        take: the solved weights.
        rmse: marker RMSE a frame, (T,), millimetres.
        seen: share of marker samples that were seen.
        alignment: the similarity from marker space to rig space, where one was estimated.
        seconds: what the solve itself took.
    """

    take: Take
    rmse: Tensor
    seen: float
    alignment: Similarity | None
    seconds: float

    def lines(self) -> list[str]:
        """For people to read."""
        frames, worst = len(self.rmse), float(self.rmse.nan_to_num().max())
        lines = [
            f"{frames} frames at {self.take.fps:g} a second, {100 * self.seen:.1f} % of the marker samples seen",
            f"marker RMSE: median {float(self.rmse.nanmedian()):.3f} mm, "
            f"95th percentile {float(self.rmse.nanquantile(0.95)):.3f} mm, worst {worst:.3f} mm",
            f"solved in {self.seconds:.2f} s, {1000 * self.seconds / max(frames, 1):.3f} ms a frame",
        ]
        if self.alignment is not None:
            moved = self.alignment.translation[0].tolist()
            lines.insert(
                1,
                f"alignment: scale {float(self.alignment.scale[0]):.4f}, moved by "
                f"({moved[0]:.1f}, {moved[1]:.1f}, {moved[2]:.1f}) mm",
            )
        return lines


def align_by_frame(rig: BlendshapeRig, attachment: Attachment, markers: Track, frame: int) -> Similarity:
    """The similarity that moves a frame with the face at rest onto the rig's neutral; one for the whole take.

    Args:
        rig: the performer's.
        attachment: where the markers sit; markers match by label.
        markers: values (T,M,3), millimetres.
        frame: which one.

    Raises:
        ValueRangeError: no such frame.
        ShapeError: fewer than three markers are seen in it.

    Source: thesis 4.1.2.
    """
    if not 0 <= frame < len(markers):
        raise ValueRangeError(
            f"neutral frame: found a take of {len(markers)} frames, expected frame {frame} among them"
        )
    labels = tuple(label for label in attachment.labels or () if label in markers.names)
    here = attachment.select(labels)
    at_rest = here.on(rig.neutral.faces, rig.vertices)
    return similarity_transform(markers.select(labels).values[frame : frame + 1].to(at_rest), at_rest[None])


def solve_take(
    rig: Path,
    take: Path,
    attachment: Path,
    out: Path,
    animation: Path | None = None,
    neutral_frame: int | None = None,
    sparsity: float | None = None,
    ridge: float | None = None,
    part: str | None = None,
    progress: Callable[[str], None] | None = None,
) -> SolveReport:
    """Reads, solves, writes; see ``torchface solve --help`` for the arguments.

    Raises:
        ValueRangeError: the take holds no markers.
        TorchfaceError: any file is broken or does not fit the others.
    """
    say = progress or (lambda line: None)
    say("reading the rig")
    loaded = load_rig(rig, part=part)
    where = Attachment.load(attachment)
    where.check(loaded.neutral, attachment, rig)
    say("reading the take")
    played = load_take(take)
    if played.markers is None:
        raise ValueRangeError(f"{take}: found no markers, expected a marker take (.c3d, .trc, .csv)")
    require_seen(played)
    alignment = None if neutral_frame is None else align_by_frame(loaded, where, played.markers, neutral_frame)
    terms = {name: value for name, value in (("sparsity", sparsity), ("ridge", ridge)) if value is not None}
    solver = MarkerSolver(loaded, where, alignment, **terms)
    say("solving")
    started = time.perf_counter()
    solved = solver.solve_take(played)
    seconds = time.perf_counter() - started
    assert solved.weights is not None
    say("writing")
    out.parent.mkdir(parents=True, exist_ok=True)
    save_live_link(solved, out)
    if animation is not None:
        animation.parent.mkdir(parents=True, exist_ok=True)
        save_animation(loaded, solved, animation)
    labels = tuple(label for label in where.labels or () if label in played.markers.names)
    markers = played.markers.select(labels).values
    if alignment is not None:
        markers = alignment.apply(markers)
    rmse = marker_rmse(loaded, where.select(labels), solved.weights.values[..., 0], markers)
    return SolveReport(solved, rmse, float(torch.isfinite(markers).all(-1).float().mean()), alignment, seconds)
