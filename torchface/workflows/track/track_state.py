"""What a run of tracking has done so far, on disk: landmarks a piece at a time, and which product is up to date."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.documents import read_json, write_json
from torchface.files.whole_files import make_folder

FOLDER = "state"
"""Where it lies in the folder of results."""

_RECORD = "track.json"
_FORMAT = "torchface.track/1"
_LANDMARKS = 68
_BLOCK = 2**22
_MAX_PIECE_BYTES = 2**28


@dataclass(frozen=True, eq=False)
class TrackedFrames:
    """What a tracker saw in T frames.

    Args:
        landmarks: (T,68,2), pixels of the video; NaN where the face is lost.
        confidence: (T,68) in [0,1].
        boxes: of the face, x, y, width, height, (T,4), pixels.
    """

    landmarks: Tensor
    confidence: Tensor
    boxes: Tensor

    def __post_init__(self) -> None:
        count = len(self.landmarks)
        found = (tuple(self.landmarks.shape), tuple(self.confidence.shape), tuple(self.boxes.shape))
        if found != ((count, _LANDMARKS, 2), (count, _LANDMARKS), (count, 4)):
            raise ShapeError(f"tracked frames: found {found}, expected (T,68,2), (T,68) and (T,4)")

    def __len__(self) -> int:
        return len(self.landmarks)

    @staticmethod
    def joined(pieces: Sequence[TrackedFrames]) -> TrackedFrames:
        """Pieces one after the other; none gives no frames."""
        if not pieces:
            return TrackedFrames(torch.zeros(0, _LANDMARKS, 2), torch.zeros(0, _LANDMARKS), torch.zeros(0, 4))
        return TrackedFrames(
            torch.cat([piece.landmarks for piece in pieces]),
            torch.cat([piece.confidence for piece in pieces]),
            torch.cat([piece.boxes for piece in pieces]),
        )


class TrackState:
    """The state of one run in its folder; a run killed at any moment finds what it had finished.

    Landmarks are kept in pieces, each a complete file; pieces of other videos, models or settings, damaged ones and
    those behind them are deleted.

    Args:
        out: the folder of results; it is made with the first piece.
        key: says what the landmarks come from, see :func:`digest`.

    Raises:
        FileFormatError: a piece cannot be read.
    """

    def __init__(self, out: str | Path, key: str) -> None:
        self.folder = Path(out) / FOLDER
        self.key = key
        self._pieces: list[TrackedFrames] = []
        self._take_up()

    @property
    def done(self) -> int:
        """Frames whose landmarks are kept."""
        return sum(map(len, self._pieces))

    def frames(self) -> TrackedFrames:
        """All that is kept."""
        return TrackedFrames.joined(self._pieces)

    def append(self, piece: TrackedFrames) -> None:
        """Keeps the next frames.

        Raises:
            FileFormatError: the folder cannot be written to.
        """
        make_folder(self.folder)
        kept = TrackedFrames(*(tensor.float() for tensor in (piece.landmarks, piece.confidence, piece.boxes)))
        write_checkpoint(self._path(len(self._pieces)), vars(kept), self._belongs_to())
        self._pieces.append(kept)

    def is_current(self, product: Path, key: str) -> bool:
        """Whether a file is there and was made from what ``key`` says."""
        return product.is_file() and self._record().get(product.name) == key

    def made(self, product: Path, key: str) -> None:
        """Notes that a complete file was made from what ``key`` says."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.folder / _RECORD, {**self._record(), product.name: key})

    def clear(self) -> None:
        """Deletes everything; folders that are empty then go too."""
        for path in [*self._files(), self.folder / _RECORD]:
            path.unlink(missing_ok=True)
        for folder in (self.folder, self.folder.parent):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
        self._pieces.clear()

    def _take_up(self) -> None:
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
            raise FileFormatError(f"{path}: found {path.stat().st_size} bytes, expected at most {_MAX_PIECE_BYTES}")
        found = read_checkpoint(path, self._belongs_to())
        try:
            return None if found is None else TrackedFrames(**found)
        except (ShapeError, TypeError):
            return None

    def _belongs_to(self) -> dict[str, str]:
        return {"format": _FORMAT, "key": self.key, "begin": str(self.done)}

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("landmarks_*.safetensors"))

    def _path(self, number: int) -> Path:
        return self.folder / f"landmarks_{number:06d}.safetensors"

    def _record(self) -> dict[str, str]:
        try:
            return {name: key.text() for name, key in read_json(self.folder / _RECORD).table().items()}
        except FileFormatError:
            return {}  # what is not known is made anew


def digest(*parts: str) -> str:
    """Thirty-two hex digits that differ where any part does."""
    whole = hashlib.sha256()
    for part in parts:
        whole.update(f"{len(part)}:{part}".encode())
    return whole.hexdigest()[:32]


def file_digest(path: Path) -> str:
    """The hash of a file's content, read a block at a time.

    Raises:
        FileFormatError: it cannot be read.
    """
    whole = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while block := file.read(_BLOCK):
                whole.update(block)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read ({error.strerror})") from error
    return whole.hexdigest()
