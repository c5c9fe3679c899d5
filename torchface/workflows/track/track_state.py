"""What a run of tracking has done so far, on disk: landmarks a piece at a time, and which product is up to date."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key, file_digest
from torchface.files.documents import read_json, write_json
from torchface.files.whole_files import make_folder
from torchface.landmarks.images.tracking.tracked_face import TrackedFace

FOLDER = "state"
"""Where it lies in the folder of results."""

_RECORD = "track.json"
_METHOD = "tracked frames/5"
_LANDMARKS = 68
_MAX_PIECE_BYTES = 2**28


@dataclass(frozen=True, eq=False)
class TrackedFrames:
    """What a tracker saw in T frames.

    Args:
        landmarks: (T,68,2), pixels of the video; NaN where the face is lost.
        confidence: (T,68) in [0,1].
        boxes: of the face, x, y, width, height, (T,4), pixels.
        visibility: (T,68) in [0,1]; 1 throughout if absent, as of a finder that does not say.
        presence: how likely it is a face, (T,) in [0,1]; 1 throughout if absent.
    """

    landmarks: Tensor
    confidence: Tensor
    boxes: Tensor
    visibility: Tensor = None  # type: ignore[assignment]
    presence: Tensor = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        count = len(self.landmarks)
        if self.visibility is None:
            object.__setattr__(self, "visibility", torch.ones(count, _LANDMARKS))
        if self.presence is None:
            object.__setattr__(self, "presence", torch.ones(count))
        expected = ((count, _LANDMARKS, 2), (count, _LANDMARKS), (count, 4), (count, _LANDMARKS), (count,))
        found = tuple(tuple(getattr(self, one.name).shape) for one in fields(self))
        if found != expected:
            raise ShapeError(f"tracked frames: found {found}, expected (T,68,2), (T,68), (T,4), (T,68) and (T,)")

    def __len__(self) -> int:
        return len(self.landmarks)

    @staticmethod
    def of_faces(faces: Sequence[TrackedFace]) -> TrackedFrames:
        """The frames in which a tracker saw these, one at least."""
        return TrackedFrames(
            torch.stack([one.landmarks for one in faces]),
            torch.stack([one.confidence for one in faces]),
            torch.stack([one.box for one in faces]),
            torch.stack([one.visibility for one in faces]),
            torch.tensor([one.presence for one in faces]),
        )

    @staticmethod
    def joined(pieces: Sequence[TrackedFrames]) -> TrackedFrames:
        """Pieces one after the other; none gives no frames."""
        if not pieces:
            return TrackedFrames(torch.zeros(0, _LANDMARKS, 2), torch.zeros(0, _LANDMARKS), torch.zeros(0, 4))
        names = [one.name for one in fields(TrackedFrames)]
        return TrackedFrames(*(torch.cat([getattr(piece, name) for piece in pieces]) for name in names))


class TrackState:
    """The state of one run in its folder; a run killed at any moment finds what it had finished.

    Landmarks are kept in pieces, each a complete file with the hash of its content; pieces of other videos, models or
    settings, damaged ones and those behind them are deleted, damaged ones with a warning; so is what a killed run left
    under a temporary name. The folder of results must be held for this run.

    Args:
        out: the folder of results; it is made with the first piece.
        key: says what the landmarks come from, see :func:`~torchface.files.content_keys.content_key`.
    """

    def __init__(self, out: str | Path, key: str) -> None:
        self.folder = Path(out) / FOLDER
        self.key = key
        self._pieces: list[TrackedFrames] = []
        self.memory = torch.zeros(0, dtype=torch.float64)
        """The tracker's after the frames that are kept."""
        self._take_up()

    @property
    def done(self) -> int:
        """Frames whose landmarks are kept."""
        return sum(map(len, self._pieces))

    def frames(self) -> TrackedFrames:
        """All that is kept."""
        return TrackedFrames.joined(self._pieces)

    def append(self, piece: TrackedFrames, memory: Tensor | None = None) -> None:
        """Keeps the next frames, and the tracker's memory after them.

        Raises:
            FileFormatError: the folder cannot be written to.
        """
        make_folder(self.folder)
        kept = TrackedFrames(*(getattr(piece, one.name).float() for one in fields(piece)))
        self.memory = torch.zeros(0, dtype=torch.float64) if memory is None else memory
        write_checkpoint(self._path(len(self._pieces)), {**vars(kept), "memory": self.memory}, self._piece_key())
        self._pieces.append(kept)

    def is_current(self, product: Path, key: str) -> bool:
        """Whether a file is there, was made from what ``key`` says, and is as it was made; a damaged one is told."""
        made_from, content = self._record().get(product.name, ("", ""))
        if made_from != key or not product.is_file():
            return False
        if file_digest(product) == content:
            return True
        warnings.warn(f"{product}: found other content than was written, it is made anew", stacklevel=2)
        return False

    def made(self, product: Path, key: str) -> None:
        """Notes that a complete file was made from what ``key`` says."""
        make_folder(self.folder)
        write_json(self.folder / _RECORD, {**self._record(), product.name: [key, file_digest(product)]})

    def clear(self) -> None:
        """Deletes everything; folders that are empty then go too."""
        for path in [*self._files(), self.folder / _RECORD]:
            path.unlink(missing_ok=True)
        for folder in (self.folder, self.folder.parent):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
        self._pieces.clear()

    def _take_up(self) -> None:
        for left_over in self.folder.glob(".*.part"):
            left_over.unlink(missing_ok=True)
        for number, path in enumerate(self._files()):
            piece = self._read(path) if path == self._path(number) else None
            if piece is None:
                for other in self._files()[number:]:
                    other.unlink(missing_ok=True)
                return
            self._pieces.append(piece)

    def _read(self, path: Path) -> TrackedFrames | None:
        """A piece, if it is one of this run and whole."""
        if path.stat().st_size > _MAX_PIECE_BYTES:
            warnings.warn(
                f"{path}: found a damaged piece of {path.stat().st_size} bytes, it is made anew", stacklevel=4
            )
            return None
        found = read_checkpoint(path, self._piece_key())
        try:
            if found is None:
                return None
            memory = found.pop("memory")
            piece = TrackedFrames(**found)
        except (ShapeError, TypeError, KeyError):
            return None
        self.memory = memory
        return piece

    def _piece_key(self) -> str:
        return content_key(_METHOD, run=self.key, begin=self.done)

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("landmarks_*.safetensors"))

    def _path(self, number: int) -> Path:
        return self.folder / f"landmarks_{number:06d}.safetensors"

    def _record(self) -> dict[str, tuple[str, str]]:
        """Of each product what it was made from, and the hash of its content."""
        try:
            rows = read_json(self.folder / _RECORD).table().items()
            return {name: (texts[0], texts[1]) for name, row in rows if len(texts := row.texts()) == 2}
        except FileFormatError:
            return {}  # what is not known is made anew
