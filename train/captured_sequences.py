"""A captured performance as files hold it: sequences of frames of one topology, gathered into one file on disk."""

import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path

import torch
from torch import Tensor

from torchface import Mesh, load_mesh
from torchface.errors import FileFormatError, TopologyError, ValueRangeError
from torchface.files.content_keys import content_key
from torchface.files.whole_files import numbered_order, visible_files
from torchface.io import MeshSequence, MeshSequenceWriter
from torchface.io.mesh_files import MESH_ENDINGS
from torchface.progress import Progress
from torchface.synthetic.stages.weight_curves import GESTURES
from torchface.synthetic.stages.wrinkles import WrinkledPerformer
from torchface.workflows.animated_meshes import AnimatedMesh, load_animated, meshes_over_time
from torchface.workflows.enhance.coarse_input import at_even_rate

_METHOD = "captured sequences/2"
_NEUTRAL = "neutral"
_ANIMATIONS = (".glb", ".gltf", ".safetensors", ".npz")
_BLOCK = 8  # frames that are read at a time
_NUMBER = re.compile(r"[ _.-]*\d+$")
_RISE, _HOLD, _FALL = (0.2, 0.5), (0.1, 0.4), (0.3, 0.7)  # seconds of a performer's expressions
_SAME_RATE = 2e-3  # relative
_TWO_SIDED = 3  # takes of each gesture: both sides, left more, right more


@dataclass(frozen=True, eq=False)
class CapturedSequence:
    """Frames from the neutral to an expression and back."""

    name: str  # of the file or folder
    count: int
    read: Callable[[int, int], Tensor]  # vertices (t,V,3) of frames from one number up to another, without it
    faces: Tensor  # (F,3) int64, of its own file
    colors: Callable[[int, int], Tensor] | None = None  # of the vertices, (t,V,3) in [0,1], where there are some
    fps: float | None = None  # frames a second, where its file says


@dataclass(frozen=True, eq=False)
class Capture:
    """Sequences of an actor, and the neutral of their topology."""

    sequences: tuple[CapturedSequence, ...]  # in order of their names
    neutral: Mesh  # with landmarks where it came with some
    neutral_file: Path | None  # where it came from; None of the performer
    key: str  # changes when any of the files does

    def part(self, begin: int, end: int) -> "Capture":
        """Some of the sequences."""
        return Capture(self.sequences[begin:end], self.neutral, self.neutral_file, f"{self.key} {begin} {end}")

    @property
    def fps(self) -> float | None:
        """Frames a second, where a file says."""
        return next((sequence.fps for sequence in self.sequences if sequence.fps is not None), None)

    def check_rate(self, fps: float | None) -> None:
        """Raises where a file says another rate than the expected one, or than the first that says one."""
        expected = self.fps if fps is None else fps
        for sequence in self.sequences:
            if sequence.fps is not None and expected is not None and abs(sequence.fps / expected - 1) > _SAME_RATE:
                whose = "of the other sequences" if fps is None else "of the frames (--fps)"
                raise ValueRangeError(
                    f"{sequence.name}: found {sequence.fps:g} frames a second, expected the {expected:g} {whose}: "
                    "timing is learned of one rate"
                )

    @property
    def colored(self) -> bool:
        """Whether all sequences have vertex colours."""
        return all(sequence.colors is not None for sequence in self.sequences)


def read_capture(folder: Path, neutral: Path | None) -> Capture:
    """The sequences of a folder: sub-folders of meshes, animations, and meshes named ``sequence_0001.obj``.

    Args:
        folder: of OBJ, PLY, STL or OFF meshes, ``.glb`` animations, mesh sequences (``.safetensors``) and ``.npz``
            files with ``vertices`` (T,V,3), millimetres, and ``faces`` (F,3).
        neutral: a mesh file; ``neutral.*`` in the folder if absent.
    """
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: found no such folder, expected one of sequences of meshes")
    entries = visible_files(folder)
    rest = _neutral_file(folder, entries) if neutral is None else neutral
    used = [entry for entry in entries if entry != rest]
    sequences = [
        _sequence(load_animated(entry)) for entry in used if entry.is_dir() or entry.suffix.lower() in _ANIMATIONS
    ]
    loose = [entry for entry in used if entry.is_file() and entry.suffix.lower() in MESH_ENDINGS]
    for name, files in groupby(loose, lambda file: _NUMBER.sub("", file.stem)):
        sequences.append(_sequence(meshes_over_time(Path(name), sorted(files, key=numbered_order), None)))
    if not sequences:
        raise FileFormatError(
            f"{folder}: found no sequences, expected folders of meshes, {', '.join(_ANIMATIONS)} files or meshes "
            "named sequence_0001.obj"
        )
    mesh = load_mesh(rest)
    for sequence in sequences:
        if not torch.equal(sequence.faces, mesh.faces):
            raise TopologyError(
                f"{folder / sequence.name}: found {len(sequence.faces)} triangles, expected the {len(mesh.faces)} of "
                f"{rest.name}, in their order: all frames must be of one topology"
            )
    read = {str(file.relative_to(folder)): file for file in sorted(folder.rglob("*")) if file.is_file()}
    key = content_key(_METHOD, files={**read, f"{_NEUTRAL}/{rest.name}": rest})
    return Capture(tuple(sequences), mesh, rest, key)


def read_pairs(folder: Path, capture: Capture) -> Capture:
    """What a coarse animation shows of a capture: the same sequences in another folder, in the capture's order."""
    capture_read = read_capture(folder, capture.neutral_file)
    named = {_bare(sequence.name): sequence for sequence in capture_read.sequences}
    for sequence in capture.sequences:
        other = named.get(_bare(sequence.name))
        if other is None or other.count != sequence.count:
            raise ValueRangeError(
                f"{folder}: found {'no sequence' if other is None else f'{other.count} frames'} for "
                f"{sequence.name}, expected its {sequence.count} frames under the same name as the coarse animation "
                "shows them"
            )
    return replace(capture_read, sequences=tuple(named[_bare(sequence.name)] for sequence in capture.sequences))


def performed(vertices: int, seed: int, fps: float) -> Capture:
    """Expressions of the wrinkled embedded performer, three takes of each, every one a sequence."""
    person = WrinkledPerformer(vertices=vertices, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    names, weights = [], []
    for take in range(_TWO_SIDED):
        for name, gesture in GESTURES.items():
            names.append(f"{name} {take + 1}")
            weights.append(_gesture(gesture, person.names, take, fps, generator))

    @lru_cache(maxsize=1)  # folding of skin remembers: a sequence is made as a whole
    def whole(number: int) -> Tensor:
        return person.frames(weights[number], fps)

    def read(number: int, begin: int, end: int) -> Tensor:
        return whole(number)[begin:end]

    sequences = [
        CapturedSequence(name, len(weights[number]), partial(read, number), person.neutral.faces)
        for number, name in enumerate(names)
    ]
    key = content_key(_METHOD, performer=vertices, seed=seed, fps=fps)
    return Capture(tuple(sequences), person.neutral, None, key)


def gather(capture: Capture, path: Path, progress: Progress, colors: bool = False) -> tuple[MeshSequence, Tensor]:
    """Writes all frames, or their colours, which all sequences have, into one file, and the number of each frame's
    sequence, (K,) int64; where an earlier run has stopped, it goes on."""
    counts = torch.tensor([sequence.count for sequence in capture.sequences])
    numbers = torch.arange(len(counts)).repeat_interleave(counts)
    key = f"{capture.key} colors" if colors else capture.key
    if path.is_file():
        kept = MeshSequence(path)
        if kept.key == key:
            return kept, numbers
    total, size = int(counts.sum()), len(capture.neutral.vertices)
    begin = 0
    with MeshSequenceWriter(path, total, size, capture.neutral.faces, key=key) as writer:
        for sequence in capture.sequences:
            for first in range(max(0, writer.done - begin), sequence.count, _BLOCK):
                read = sequence.colors if colors else sequence.read
                assert read is not None
                frames = read(first, min(first + _BLOCK, sequence.count))
                _check(frames, sequence.name, first, size)
                writer.append(frames)
                progress("gathering colours" if colors else "gathering frames", writer.done, total)
            begin += sequence.count
    return MeshSequence(path), numbers


def _check(frames: Tensor, name: str, first: int, size: int) -> None:
    if frames.shape[1:] != (size, 3):
        raise TopologyError(f"{name}: found frames {tuple(frames.shape[1:])}, expected ({size},3)")
    bad = (~torch.isfinite(frames)).flatten(1).any(1).nonzero()[:, 0]
    if len(bad):
        raise ValueRangeError(f"{name}: frame {first + int(bad[0])} holds NaN or infinite vertices, expected none")


def _neutral_file(folder: Path, entries: list[Path]) -> Path:
    endings = (*MESH_ENDINGS, ".glb", ".gltf")
    neutrals = [entry for entry in entries if entry.stem.lower() == _NEUTRAL and entry.suffix.lower() in endings]
    if len(neutrals) != 1:
        raise FileFormatError(
            f"{folder}: found {len(neutrals)} files called {_NEUTRAL}, expected one, such as {_NEUTRAL}.obj, "
            "or --neutral"
        )
    return neutrals[0]


def _bare(name: str) -> str:
    """A sequence's name without a file's ending."""
    return Path(name).stem if name.lower().endswith(_ANIMATIONS) else name


def _sequence(animated: AnimatedMesh) -> CapturedSequence:
    found, notes = at_even_rate(animated, None)
    for note in notes:
        warnings.warn(note.removeprefix("warning: "), stacklevel=3)
    return CapturedSequence(found.path.name, found.count, found.read, found.neutral.faces, found.colors, found.fps)


def _gesture(
    gesture: Mapping[str, float], names: tuple[str, ...], take: int, fps: float, generator: torch.Generator
) -> Tensor:
    """Weights (T,N) that rise to an expression and fall again, the later takes more on one side."""
    rise, hold, fall = (a + (b - a) * float(torch.rand((), generator=generator)) for a, b in (_RISE, _HOLD, _FALL))
    seconds = torch.arange(round((rise + hold + fall) * fps) + 1) / fps
    up = (seconds / rise).clamp(0, 1)
    down = ((rise + hold + fall - seconds) / fall).clamp(0, 1)
    envelope = 0.5 - 0.5 * (torch.pi * torch.minimum(up, down)).cos()
    envelope[-1] = 0.0
    strength = 0.7 + 0.3 * float(torch.rand((), generator=generator))
    weak = {1: "Right", 2: "Left"}.get(take)
    weights = torch.zeros(len(seconds), len(names))
    for name, weight in gesture.items():
        if name in names:
            side = 0.35 if weak is not None and name.endswith(weak) else 1.0
            weights[:, names.index(name)] = weight * side * strength * envelope
    return weights
