"""Weights for a prior to learn from: of weight takes, of marker takes solved with their rig, or made up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, load_take
from torchface.capture.priors import resampled
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.progress import Progress, silent
from torchface.shape_names import mapping
from torchface.synthetic.stages.weight_curves import perform
from torchface.workflows.solve.solve_take import SolveSettings, solve_markers

_SUFFIXES = (".csv", ".c3d", ".trc")
_SAME_RATE = 1e-3  # relative; 59.94 and 60 frames a second are not the same, rounding is


@dataclass(frozen=True, eq=False)
class PriorTakes:
    """Takes of one set of shapes at one frame rate.

    Args:
        names: of the N shapes.
        fps: frames a second.
        weights: of each take, (T,N), clipped to [0,1].
        labels: what each take is called.
        solved: how many of them were solved from markers.
    """

    names: tuple[str, ...]
    fps: float
    weights: list[Tensor]
    labels: list[str]
    solved: int = 0

    def some(self, rows: Sequence[int]) -> PriorTakes:
        """Some of the takes."""
        return PriorTakes(
            self.names, self.fps, [self.weights[row] for row in rows], [self.labels[row] for row in rows], self.solved
        )


def read_takes(
    folder: Path,
    fps: float | None = None,
    rig: BlendshapeRig | None = None,
    attachment: Attachment | None = None,
    progress: Progress | None = None,
) -> PriorTakes:
    """All takes of a folder, by name.

    Args:
        folder: with .csv, .c3d and .trc files.
        fps: frame rate to bring all takes to; that of the first if absent.
        rig: of the performer of marker takes.
        attachment: where the markers sit on the rig.
        progress: called with each step and how far it is.

    Raises:
        FileFormatError: there are no takes, or one cannot be read.
        NameMismatchError: two takes have different shapes, or a take has markers and there is no rig or attachment.
        ValueRangeError: a take holds NaN, or neither weights nor markers.
    """
    progress = progress or silent
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: found no such folder, expected one with takes")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES)
    if not paths:
        raise FileFormatError(f"{folder}: found no take, expected files ending in {', '.join(_SUFFIXES)}")
    names: tuple[str, ...] | None = None
    weights: list[Tensor] = []
    solved = 0
    for path in paths:
        progress(f"reading {path.name}")
        take = load_take(path)
        if take.weights is None and take.markers is not None:
            if rig is None or attachment is None:
                raise NameMismatchError(
                    f"{path}: found markers, expected weights, or the rig and the attachment that solve them"
                )
            progress(f"solving {path.name}")
            take = solve_markers(rig, attachment, take, SolveSettings(align=True)).take
            solved += 1
        if take.weights is None:
            raise ValueRangeError(f"{path}: found neither weights nor markers, expected one of them")
        values = take.weights.values[..., 0].double()
        bad = (~torch.isfinite(values)).any(1).nonzero()[:, 0]
        if len(bad):
            raise ValueRangeError(
                f"{path}: found NaN or infinity in {len(bad)} of {len(values)} frames (the first is {int(bad[0])}), "
                "expected weights in all"
            )
        if names is None:
            names, fps = take.weights.names, take.fps if fps is None else fps
        _check_names(names, take.weights.names, paths[0], path)
        assert fps is not None
        if abs(take.fps - fps) > _SAME_RATE * fps:
            values = resampled(values, take.fps, fps)
        weights.append(values.clamp(0.0, 1.0))
    assert names is not None
    assert fps is not None
    return PriorTakes(names, fps, weights, [path.stem for path in paths], solved)


def synthetic_takes(count: int, frames: int, seed: int, fps: float | None = None) -> PriorTakes:
    """Takes of the embedded performer; each draws from a seed of its own."""
    rate = 60.0 if fps is None else fps
    takes = [perform(frames, torch.Generator().manual_seed(seed + number), rate) for number in range(count)]
    tracks = [take.weights for take in takes if take.weights is not None]
    return PriorTakes(
        tracks[0].names,
        rate,
        [track.values[..., 0].double() for track in tracks],
        [f"made up {i}" for i in range(count)],
    )


def renamed(takes: PriorTakes, names: Sequence[str]) -> tuple[PriorTakes, tuple[str, ...]]:
    """The takes in a rig's shapes: whole shapes drive both halves of split ones, halves give wholes their mean.

    Returns:
        The takes, and the shapes that they say nothing of, which stay at 0.

    Raises:
        NameMismatchError: the takes have none of the shapes.
    """
    matrix = mapping(takes.names, names).double()
    silent = tuple(name for name, row in zip(names, matrix, strict=True) if not row.any())
    if len(silent) == len(names):
        raise NameMismatchError(
            f"names: found {', '.join(names[:3])}, ..., none of which the takes have; expected names such as "
            f"{', '.join(takes.names[:3])}"
        )
    weights = [(take @ matrix.T).clamp(0.0, 1.0) for take in takes.weights]
    return PriorTakes(tuple(names), takes.fps, weights, takes.labels, takes.solved), silent


def split(takes: PriorTakes, held_out: int | None) -> tuple[PriorTakes, PriorTakes]:
    """Takes to learn from, and the last ones to test on: a third of them if not said.

    Raises:
        ShapeError: there are too few.
    """
    count = len(takes.weights)
    last = max(count // 3, 1) if held_out is None else held_out
    if not 1 <= last < count:
        raise ShapeError(
            f"takes: found {count} of which {last} are to be held out, expected at least one to learn from and one to "
            "test on"
        )
    return takes.some(range(count - last)), takes.some(range(count - last, count))


def _check_names(names: tuple[str, ...], others: tuple[str, ...], first: Path, path: Path) -> None:
    if names != others:
        odd = [name for name in others if name not in set(names)] + [name for name in names if name not in set(others)]
        shown = ", ".join(odd[:3]) if odd else "the same in another order"
        raise NameMismatchError(
            f"{path}: found other shapes than in {first.name} ({shown}), expected the same in all takes"
        )
