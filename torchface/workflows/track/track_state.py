"""What a run of tracking has done so far, on disk: landmarks a piece at a time, and which product is up to date."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError
from torchface.files.whole_files import read_file, write_file

FOLDER = "state"
"""Where it lies in the folder of results."""

_RECORD = "track.json"
_FORMAT = "torchface.track/1"
_LANDMARKS = 68
_BLOCK = 2**22
_MAX_RECORD = 2**16
_MAX_PIECE = 2**28


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
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FileFormatError(f"{self.folder}: cannot be made ({error.strerror})") from error
        tensors = {"landmarks": piece.landmarks, "confidence": piece.confidence, "boxes": piece.boxes}
        packed = {name: tensor.detach().cpu().float().contiguous() for name, tensor in tensors.items()}
        metadata = {"format": _FORMAT, "key": self.key, "begin": str(self.done)}
        write_file(self._path(len(self._pieces)), save(packed, metadata))
        self._pieces.append(TrackedFrames(**packed))

    def is_current(self, product: Path, key: str) -> bool:
        """Whether a file is there and was made from what ``key`` says."""
        return product.is_file() and self._record().get(product.name) == key

    def made(self, product: Path, key: str) -> None:
        """Notes that a complete file was made from what ``key`` says."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_file(self.folder / _RECORD, json.dumps({**self._record(), product.name: key}, indent=1).encode())

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
        data = read_file(path, _MAX_PIECE)
        try:
            length = int.from_bytes(data[:8], "little")
            header = json.loads(data[8 : 8 + length])["__metadata__"]
            expected = {"format": _FORMAT, "key": self.key, "begin": str(self.done)}
            if header != expected:
                return None
            return TrackedFrames(**load(data))
        except (SafetensorError, ShapeError, ValueError, KeyError, TypeError, RecursionError):
            return None

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("landmarks_*.safetensors"))

    def _path(self, number: int) -> Path:
        return self.folder / f"landmarks_{number:06d}.safetensors"

    def _record(self) -> dict[str, str]:
        try:
            found = json.loads(read_file(self.folder / _RECORD, _MAX_RECORD))
        except (FileFormatError, ValueError, RecursionError):
            return {}  # what is not known is made anew
        return found if isinstance(found, dict) else {}


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
