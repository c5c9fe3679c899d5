"""What enhancement is measured on: wrinkled performers of known truth, moved by real takes.

The database holds the neutral and frames of four whole takes, a few a second, cut into expressions that rise from rest
and fall back to it; the other two takes are the test, their liveliest seconds at 30 frames a second. The coarse
animation is the same performer's without its wrinkles.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from planted.expression_sequences import expression_sequences
from torchface import BlendshapeRig, load_rig, load_take
from torchface.shape_names import mapping
from torchface.synthetic.stages.wrinkles import WrinkledPerformer

FPS = 30.0
DATABASE_TAKES, TEST_TAKES = 4, 2
_RUN_UP = 10  # frames before those that are kept: wrinkles unfold with a lag
_EACH = 3  # frames of a take of which the database's performer makes one
_BATCH = 40  # frames


@dataclass(frozen=True, eq=False)
class Scene:
    """A performer, the captured frames of it, and an animation with its truth."""

    name: str  # `performer` or `ict`
    performer: WrinkledPerformer  # what was captured
    frames: Tensor  # the database, (K,V,3), millimetres; the first is the neutral
    sequences: Tensor  # of each of its frames, (K,) int64
    rigged: Tensor  # the same frames as the rig alone moves them, without wrinkles, (K,V,3)
    weights: Tensor  # of each of its frames, (K,N)
    coarse: tuple[Tensor, ...]  # a window of each test take without wrinkles, (T,V,3) each
    truth: tuple[Tensor, ...]  # the same with them
    test_weights: tuple[Tensor, ...]  # of these frames, (T,N) each

    @property
    def neutral(self) -> Tensor:
        return self.performer.neutral.vertices

    @property
    def faces(self) -> Tensor:
        return self.performer.neutral.faces


def wrinkled(kind: str, data: Path, vertices: int) -> WrinkledPerformer:
    """The embedded performer, or ICT-FaceKit's face, of about so many vertices."""
    if kind == "performer":
        return WrinkledPerformer(vertices=vertices, seed=0)
    return WrinkledPerformer(rig=load_rig(data / "ict_facekit" / "FaceXModel", part="face"), vertices=vertices, seed=0)


def make_scene(kind: str, data: Path, vertices: int, database: int = 400, window: int = 45) -> Scene:
    """A scene with a database of about so many frames, and windows of so many frames of two other takes."""
    return scene_of(kind, wrinkled(kind, data, vertices), data, database, window)


def scene_of(kind: str, performer: WrinkledPerformer, data: Path, database: int = 400, window: int = 45) -> Scene:
    """The same of any performer."""
    takes = take_weights(performer.rig, data)
    frames, weights, sequences = [performer.frames(torch.zeros(1, len(performer.names)), FPS)], [], [torch.tensor([0])]
    weights.append(torch.zeros(1, len(performer.names)))
    for take in takes[:DATABASE_TAKES]:
        kept = torch.arange(0, len(take), max(1, DATABASE_TAKES * len(take) // (_EACH * database)) * _EACH)
        sparse = kept // _EACH
        frames.append(in_batches(lambda rows: performer.frames(rows, FPS / _EACH), take[::_EACH], sparse))
        weights.append(take[kept])
        edges = sorted({edge for piece in expression_sequences(take, performer.names, FPS)
                        for edge in (piece.start, piece.stop)})  # fmt: skip
        sequences.append(int(sequences[-1].max()) + 1 + torch.bucketize(kept, torch.tensor(edges), right=True))
    coarse, truth, shown = [], [], []
    for take in takes[DATABASE_TAKES : DATABASE_TAKES + TEST_TAKES]:
        first = liveliest(take * performer.rig.deltas.norm(dim=(1, 2)), window)
        run_up = min(first, _RUN_UP)
        truth.append(performer.frames(take[first - run_up : first + window], FPS)[run_up:])
        coarse.append(performer.smooth(take[first : first + window]))
        shown.append(take[first : first + window])
    known = torch.cat(weights)
    return Scene(
        kind, performer, torch.cat(frames), torch.cat(sequences), performer.smooth(known), known, tuple(coarse),
        tuple(truth), tuple(shown),
    )  # fmt: skip


def take_weights(rig: BlendshapeRig, data: Path) -> list[Tensor]:
    """The real takes as weights of a rig at 30 frames a second, (T,N) each; gaze moves no skin and is left out."""
    found = []
    looks = torch.tensor(["look" in name.lower() for name in rig.names])
    for path in sorted((data / "performances").glob("*.csv")):
        track = load_take(path).weights
        weights = (track.values[::2, :, 0] @ mapping(track.names, rig.names).T).clamp(0, 1)
        found.append(weights.masked_fill(looks, 0.0))
    return found


def in_batches(made: Callable[[Tensor], Tensor], weights: Tensor, kept: Tensor) -> Tensor:
    """Some of the frames (T,V,3) that weights (T,N) make, those before each batch of them made and left out."""
    found = []
    for rows in kept.split(_BATCH):
        first = max(0, int(rows[0]) - _RUN_UP)
        found.append(made(weights[first : int(rows[-1]) + 1])[rows - first])
    return torch.cat(found)


def liveliest(motion: Tensor, window: int) -> int:
    """Where the frames begin that differ most among themselves, of numbers (T,N) that say how far each shape moves."""
    return int(motion.unfold(0, window, 1).var(2).sum(1).argmax())
