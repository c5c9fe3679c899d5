"""Weights of takes on disk, a file a take, so that a prior can learn from more of them than memory holds."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import torch
from torch import Tensor

from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.whole_files import make_folder

from .tensor_shards import Shards


@dataclass(frozen=True, eq=False)
class StoredTake:
    """A take as it is stored."""

    names: tuple[str, ...]  # of the N shapes
    fps: float  # frames a second
    weights: Tensor  # (T,N)
    solved: bool  # whether they were solved from markers


@dataclass(frozen=True, eq=False)
class TakesRead(Sequence[Tensor]):
    """Some takes of others, each read, and changed, when it is asked for."""

    takes: Sequence[Tensor]  # weights of each, (T,N)
    rows: tuple[int, ...]
    change: Callable[[Tensor], Tensor] | None = None  # what is done with each; nothing if absent

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, number: int) -> Tensor: ...
    @overload
    def __getitem__(self, number: slice) -> "TakesRead": ...
    def __getitem__(self, number: int | slice) -> "Tensor | TakesRead":
        if isinstance(number, slice):
            return TakesRead(self.takes, self.rows[number], self.change)
        take = self.takes[self.rows[number]]
        return take if self.change is None else self.change(take)


class TakesOnDisk(Sequence[Tensor]):
    """Takes of files, (T,N) float64 each; one that is asked for is read."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._shards = Shards(paths, ["weights"])

    @property
    def frames(self) -> tuple[int, ...]:
        """T of each."""
        return self._shards.counts

    def __len__(self) -> int:
        return len(self._shards.counts)

    @overload
    def __getitem__(self, number: int) -> Tensor: ...
    @overload
    def __getitem__(self, number: slice) -> TakesRead: ...
    def __getitem__(self, number: int | slice) -> Tensor | TakesRead:
        if isinstance(number, slice):
            return TakesRead(self, tuple(range(len(self)))[number])
        return self._shards.shard(range(len(self))[number])["weights"].double()


class TakeStore:
    """Writes takes one after the other into a folder; those that an earlier run has written of the same are read
    instead."""

    def __init__(self, folder: Path, count: int) -> None:
        make_folder(folder)
        self._paths = [folder / f"take_{number:06}.safetensors" for number in range(count)]
        self._done = 0
        self.solved = 0
        """How many takes so far were solved from markers."""

    def stored(self, key: str, make: Callable[[], StoredTake]) -> StoredTake:
        """The next take; it is made where there is none of this key, or a damaged one."""
        path = self._paths[self._done]
        take = _unpacked(read_checkpoint(path, key))
        if take is None:
            take = make()
            write_checkpoint(path, _packed(take), key)
        self._done += 1
        self.solved += take.solved
        return take

    def takes(self) -> TakesOnDisk:
        """All that were written."""
        return TakesOnDisk(self._paths[: self._done])


def _packed(take: StoredTake) -> dict[str, Tensor]:
    facts = json.dumps({"names": take.names, "fps": take.fps, "solved": take.solved}).encode()
    return {"weights": take.weights.float(), "facts": torch.frombuffer(bytearray(facts), dtype=torch.uint8)}


def _unpacked(found: dict[str, Tensor] | None) -> StoredTake | None:
    if found is None:
        return None
    try:
        facts, weights = json.loads(bytes(found["facts"].tolist())), found["weights"].double()
        names, fps, solved = tuple(facts["names"]), float(facts["fps"]), bool(facts["solved"])
    except (KeyError, ValueError, TypeError):  # of something else
        return None
    return StoredTake(names, fps, weights, solved) if weights.shape[1:] == (len(names),) else None
