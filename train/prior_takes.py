"""Weights for a prior to learn from: of weight takes, of marker takes solved with their rig, or made up."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, load_take
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.files.content_keys import content_key
from torchface.files.whole_files import visible_files
from torchface.progress import Progress, silent
from torchface.shape_names import mapping
from torchface.workflows.solve.solution import SolveSettings, solve_markers

from .people_performances import converse
from .people_split import held_out_people
from .take_store import StoredTake, TakesRead, TakeStore

_METHOD = "takes of priors/2"
_SUFFIXES = (".csv", ".c3d", ".trc")
_SAME_RATE = 1e-3  # relative; 59.94 and 60 frames a second are not the same, rounding is


@dataclass(frozen=True, eq=False)
class PriorTakes:
    """Takes of one set of shapes at one frame rate."""

    names: tuple[str, ...]  # of the N shapes
    fps: float  # frames a second
    weights: Sequence[Tensor]  # of each take, (T,N), clipped to [0,1]; read from disk as they are asked for
    labels: Sequence[str]  # what each take is called
    frames: Sequence[int]  # T of each take
    people: Sequence[str]  # whom each take shows, by any name
    solved: int = 0  # how many of them were solved from markers

    def some(self, rows: Sequence[int]) -> "PriorTakes":
        """Some of the takes; none is read."""
        return replace(
            self,
            weights=TakesRead(self.weights, tuple(rows)),
            labels=[self.labels[row] for row in rows],
            frames=[self.frames[row] for row in rows],
            people=[self.people[row] for row in rows],
        )

    def spread(self, most: int) -> "PriorTakes":
        """At most so many of the takes, evenly spread."""
        count = len(self.weights)
        return self if count <= most else self.some([row * count // most for row in range(most)])


def read_takes(
    folder: Path,
    work: Path,
    fps: float | None = None,
    rig: BlendshapeRig | None = None,
    attachment: Attachment | None = None,
    progress: Progress | None = None,
) -> PriorTakes:
    """All takes of a folder, or of one for each person, by name; one is in memory at a time, the weights are kept in
    ``work``.

    They are brought to ``fps``, else to the first one's; marker takes are of the rig and the attachment.
    """
    progress = progress or silent
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: found no such folder, expected one with takes")
    folders = (folder, *(one for one in visible_files(folder) if one.is_dir()))
    paths = sorted(path for one in folders for path in visible_files(one, _SUFFIXES) if path.is_file())
    if not paths:
        raise FileFormatError(f"{folder}: found no take, expected files ending in {', '.join(_SUFFIXES)}")
    solver = content_key(_METHOD, rig=_content(rig), attachment=attachment)
    store = TakeStore(work, len(paths))
    first: StoredTake | None = None
    for number, path in enumerate(paths):
        progress(f"reading {path.name}", number + 1, len(paths))
        key = content_key(_METHOD, file=path, fps=fps, solver=solver)
        take = store.stored(key, lambda path=path, rate=fps: _read(path, rate, rig, attachment, progress))  # type: ignore[misc]
        if first is None:
            first, fps = take, take.fps
        _check_names(first.names, take.names, paths[0], path)
    assert first is not None
    people = [str(path) if path.parent == folder else path.parent.name for path in paths]
    return _stored(store, first, [path.stem for path in paths], people)


def _read(
    path: Path, fps: float | None, rig: BlendshapeRig | None, attachment: Attachment | None, progress: Progress
) -> StoredTake:
    """The weights of a file, clipped, at a frame rate."""
    take, solved = load_take(path), False
    if take.weights is None and take.markers is not None:
        if rig is None or attachment is None:
            raise NameMismatchError(
                f"{path}: found markers, expected weights, or the rig and the attachment that solve them"
            )
        progress(f"solving {path.name}")
        take, solved = solve_markers(rig, attachment, take, SolveSettings(align=True)).take, True
    if take.weights is None:
        raise ValueRangeError(f"{path}: found neither weights nor markers, expected one of them")
    values = take.weights.values[..., 0].double()
    bad = (~torch.isfinite(values)).any(1).nonzero()[:, 0]
    if len(bad):
        raise ValueRangeError(
            f"{path}: found NaN or infinity in {len(bad)} of {len(values)} frames (the first is {int(bad[0])}), "
            "expected weights in all"
        )
    fps = take.fps if fps is None else fps
    if take.seconds is not None or abs(take.fps - fps) > _SAME_RATE * fps:
        even = take.resampled(fps).weights
        assert even is not None
        values = even.values[..., 0].double()
    return StoredTake(take.weights.names, fps, values.clamp(0.0, 1.0), solved)


def synthetic_takes(
    count: int, frames: int, seed: int, work: Path, fps: float | None = None, progress: Progress | None = None
) -> PriorTakes:
    """Takes of people made by code (``converse``), kept in a folder as by :func:`read_takes`; each has its own seed."""
    progress, rate = progress or silent, 60.0 if fps is None else fps
    store = TakeStore(work, count)

    def made(number: int) -> StoredTake:
        track = converse(frames, torch.Generator().manual_seed(seed + number), rate).weights
        assert track is not None
        return StoredTake(track.names, rate, track.values[..., 0], False)

    first: StoredTake | None = None
    for number in range(count):
        key = content_key(_METHOD, frames=frames, seed=seed + number, fps=rate)
        take = store.stored(key, lambda number=number: made(number))  # type: ignore[misc]
        first = take if first is None else first
        progress("making takes up", number + 1, count)
    assert first is not None
    labels = [f"person {i}" for i in range(count)]
    return _stored(store, first, labels, labels)


def _stored(store: TakeStore, first: StoredTake, labels: Sequence[str], people: Sequence[str]) -> PriorTakes:
    takes = store.takes()
    return PriorTakes(first.names, first.fps, takes, labels, takes.frames, people, store.solved)


def _content(rig: BlendshapeRig | None) -> object:
    """What solved weights depend on."""
    return None if rig is None else [list(rig.names), rig.vertices, rig.deltas]


def renamed(takes: PriorTakes, names: Sequence[str]) -> tuple[PriorTakes, tuple[str, ...]]:
    """The takes in a rig's shapes: whole shapes drive both halves of split ones, halves give wholes their mean.

    Returns:
        The takes, each renamed as it is read, and the shapes that they say nothing of, which stay at 0.
    """
    matrix = mapping(takes.names, names).double()
    silent = tuple(name for name, row in zip(names, matrix, strict=True) if not row.any())
    if len(silent) == len(names):
        raise NameMismatchError(
            f"names: found {', '.join(names[:3])}, ..., none of which the takes have; expected names such as "
            f"{', '.join(takes.names[:3])}"
        )
    weights = TakesRead(takes.weights, tuple(range(len(takes.weights))), lambda take: (take @ matrix.T).clamp(0.0, 1.0))
    return replace(takes, names=tuple(names), weights=weights), silent


def split(takes: PriorTakes, held_out: int | None) -> tuple[PriorTakes, PriorTakes]:
    """Takes to learn from, and the last ones to test on, with all others of the same people: a third if not said."""
    count = len(takes.weights)
    learn, test = held_out_people(takes.people, max(count // 3, 1) if held_out is None else held_out)
    if not learn or not test:
        raise ShapeError(
            f"--held-out: found {len(test)} of {count} takes, with all others of the same people; expected at "
            "least one take to learn from and one to test on"
        )
    return takes.some(learn), takes.some(test)


def _check_names(names: tuple[str, ...], others: tuple[str, ...], first: Path, path: Path) -> None:
    if names != others:
        odd = [name for name in others if name not in set(names)] + [name for name in names if name not in set(others)]
        shown = ", ".join(odd[:3]) if odd else "the same in another order"
        raise NameMismatchError(
            f"{path}: found other shapes than in {first.name} ({shown}), expected the same in all takes"
        )
