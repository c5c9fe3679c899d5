"""The frames of an animation enhanced onto the disk, in the actor's timing where asked for; a killed run continues."""

import math
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.enhancement import EnhancementModel
from torchface.enhancement.animation_retiming import at_moments, retimed_moments
from torchface.errors import FileFormatError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.whole_files import make_folder
from torchface.io import MeshSequence, MeshSequenceWriter
from torchface.progress import Progress
from torchface.workflows.enhance.coarse_animation import CoarseAnimation

SEQUENCE, COLORS = "enhanced.safetensors", "colors.safetensors"
_VALUES_A_PIECE = 2**23
_MOST_A_PIECE = 16


@dataclass(frozen=True, eq=False)
class EnhancedFrames:
    """What came of an animation."""

    sequence: MeshSequence
    colors: MeshSequence | None  # their vertex colours, on disk; None where the model has none
    distances: Tensor  # of each region from the database, relative to the database's own spread, (T,R)
    outside: Tensor  # frames and regions that the database does not hold, (T,R) bool
    seconds: float = 0.0  # that the frames took which this run enhanced, and how many these were
    enhanced: int = 0


def piece_size(vertices: int) -> int:
    """How many frames go through the model at once."""
    return max(1, min(_MOST_A_PIECE, _VALUES_A_PIECE // (3 * vertices)))


def check_space(out: Path, frames: int, vertices: int, colors: bool) -> None:
    """Raises ``FileFormatError`` where the disk has no room for an animation, before any work."""
    wanted = 12 * frames * vertices * (2 if colors else 1)
    free = shutil.disk_usage(out).free + sum(
        found.stat().st_size for name in (SEQUENCE, COLORS) for found in out.glob(f"{name}*")
    )
    if free < wanted:
        raise FileFormatError(
            f"{out}: found {free / 1e6:,.1f} MB free, expected {wanted / 1e6:,.1f} for {frames} frames of {vertices} "
            "vertices; make room, or write to another disk (--out)"
        )


def enhance_frames(
    animation: CoarseAnimation, model: EnhancementModel, out: Path, state: Path, key: str, progress: Progress
) -> EnhancedFrames:
    """Enhances an animation into files of a folder; the folder ``state`` keeps what a killed run leaves to the next
    of one key."""
    make_folder(out)
    make_folder(state)
    count, vertices = animation.count, len(model.neutral)
    colored = has_colors(model)
    distances, outside, previous = [], [], None
    step, seconds, fresh = piece_size(vertices), 0.0, 0
    with (
        _Output(out / SEQUENCE, animation, model, key) as meshes,
        _Output(out / COLORS if colored else None, animation, model, key) as colors,
    ):
        if meshes.done == 0:
            check_space(out, count, vertices, colored)
        for begin in range(0, count, step):
            end = min(begin + step, count)
            kept = read_checkpoint(_piece(state, begin), key)
            if kept is None or min(meshes.done, colors.done) < end:
                started = time.perf_counter()
                with torch.no_grad():
                    enhanced = model.enhance(animation.read(begin, end), previous)
                    shades = model.colors(enhanced.weights) if colored else None
                kept = {"distances": enhanced.distances, "outside": enhanced.outside, "previous": enhanced.weights[-1]}
                write_checkpoint(_piece(state, begin), kept, key)
                meshes.append(begin, enhanced.vertices)
                if shades is not None:
                    colors.append(begin, shades)
                seconds, fresh = seconds + time.perf_counter() - started, fresh + end - begin
            distances.append(kept["distances"])
            outside.append(kept["outside"])
            previous = kept["previous"]
            progress("enhancing", end, count)
    return EnhancedFrames(
        MeshSequence(out / SEQUENCE),
        MeshSequence(out / COLORS) if colored else None,
        torch.cat(distances),
        torch.cat(outside),
        seconds,
        fresh,
    )


def has_colors(model: EnhancementModel) -> bool:
    """Whether a model knows its actor's colours."""
    return len(model.mean_color) > 0


class _Output:
    """A mesh sequence that is written, or that an earlier run has finished; or none."""

    def __init__(self, path: Path | None, animation: CoarseAnimation, model: EnhancementModel, key: str) -> None:
        self._writer: MeshSequenceWriter | None = None
        count = self.done = animation.count
        if path is None or _is_finished(path, count, key):
            return
        self._writer = MeshSequenceWriter(path, count, len(model.neutral), model.faces, key=key, fps=animation.fps)
        self.done = self._writer.done

    def append(self, begin: int, vertices: Tensor) -> None:
        """Adds the frames from ``begin`` on that are not there yet."""
        if self._writer is not None and self.done < begin + len(vertices):
            self._writer.append(vertices[self.done - begin :])
            self.done = self._writer.done

    def __enter__(self) -> "_Output":
        return self

    def __exit__(self, *error: object) -> None:
        if self._writer is not None:
            self._writer.close()


def _is_finished(path: Path, count: int, key: str) -> bool:
    if not path.is_file():
        return False
    try:
        sequence = MeshSequence(path)
        return sequence.key == key and len(sequence) == count and sequence.is_whole()
    except FileFormatError:
        return False  # made anew


def _piece(state: Path, begin: int) -> Path:
    return state / f"frames_{begin:06d}.safetensors"


def retimed_animation(animation: CoarseAnimation, model: EnhancementModel, progress: Progress) -> CoarseAnimation:
    """The animation with its keyframes where they are, and the motions between them in the actor's timing."""
    step, features = piece_size(len(model.neutral)), []
    for begin in range(0, animation.count, step):
        progress("reading for the timing", begin, animation.count)
        with torch.no_grad():
            features.append(model.features(animation.read(begin, min(begin + step, animation.count))))
    progress("timing the motions between keyframes")
    moments = retimed_moments(model, torch.cat(features), animation.fps)
    shares = model.vertex_weights

    def read(begin: int, end: int) -> Tensor:
        asked = moments[:, begin:end]
        first = math.floor(float(asked.min()))
        last = min(math.ceil(float(asked.max())) + 1, animation.count)
        return at_moments(animation.read(first, last), asked - first, shares)

    note = shift_note((moments - torch.arange(animation.count)).abs() / animation.fps, model.region_names)
    return replace(animation, read=read, notes=(*animation.notes, note), moments=moments)


def shift_note(shifts: Tensor, names: Sequence[str]) -> str:
    """How far regions' frames (R,T) were moved in time, seconds, in words."""
    if not float(shifts.max()) > 0:
        return "retimed: no motion between keyframes was found; the timing is the input's"
    furthest = shifts.amax(1)
    region, moved = int(furthest.argmax()), shifts > 0
    return (
        f"retimed: motions between keyframes take the actor's timing; {float(moved.any(0).float().mean()):.0%} of the "
        f"frames show another moment, {float(shifts[moved].mean()):.2f} s away in the mean and at most "
        f"{float(furthest[region]):.2f} s ({names[region]})"
    )
