"""State of a run of tracking on disk: readings of frames a piece at a time, and which product is up to date."""

import warnings
from dataclasses import fields
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.own_rig.another_face import FilmLooks
from torchface.errors import FileFormatError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key, file_digest
from torchface.files.documents import read_json, write_json
from torchface.files.whole_files import make_folder
from torchface.landmarks.images.face_reading import FaceReading

FOLDER = "state"
"""Where it lies in the folder of results."""

_RECORD = "track.json"
_METHOD = "tracked frames/10"
_MAX_PIECE_BYTES = 2**28
_PARTS = fields(FaceReading)


class TrackState:
    """The state of one run in its folder; a run killed at any moment finds what it had finished.

    Readings are kept in pieces, each a complete file with the hash of its content; pieces of other videos, models or
    settings, damaged ones and those behind them are deleted, damaged ones with a warning; so is what a killed run left
    under a temporary name. The folder of results must be held for this run.
    """

    def __init__(self, out: str | Path, key: str) -> None:
        self.folder = Path(out) / FOLDER
        self.key = key
        self._pieces: list[FaceReading] = []
        self._looks: list[Tensor] = []
        self._changes: list[Tensor] = []
        self.memory = torch.zeros(0, dtype=torch.float64)
        """The tracker's after the frames that are kept."""
        self._take_up()

    @property
    def done(self) -> int:
        """Frames whose readings are kept."""
        return sum(len(piece.landmarks) for piece in self._pieces)

    def reading(self) -> FaceReading:
        """All that is kept, (T,...)."""
        nobody = FaceReading.stacked([FaceReading.lost()])
        none = FaceReading(*(getattr(nobody, part.name)[:0] for part in _PARTS))
        return FaceReading.joined([none, *self._pieces])

    def looks(self) -> FilmLooks:
        """How the film and the face look in all frames that are kept."""
        looks = torch.cat(self._looks).float()
        faces = torch.where(looks.any(1, keepdim=True), looks / looks.norm(dim=1, keepdim=True), torch.nan)
        return FilmLooks(faces, torch.cat(self._changes))

    def append(self, piece: FaceReading, looks: FilmLooks, memory: Tensor) -> None:
        """Keeps the reading of the next frames (T,...), their looks, and the tracker's memory after them."""
        make_folder(self.folder)
        self.memory = memory
        # A byte a number is enough for a correlation.
        largest = looks.faces.abs().amax(1, keepdim=True).clamp(min=1e-9)
        coarse = (127 * looks.faces / largest).nan_to_num(0.0).round().to(torch.int8)
        parts = {**vars(piece), "look": coarse, "change": looks.changes, "memory": memory}
        write_checkpoint(self._path(len(self._pieces)), parts, self._piece_key())
        self._pieces.append(piece)
        self._looks.append(coarse)
        self._changes.append(looks.changes)

    def is_current(self, product: Path, key: str) -> bool:
        """Whether a file is there, was made from what ``key`` says, and is as it was made; warns of a damaged one."""
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
        self._looks.clear()
        self._changes.clear()

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

    def _read(self, path: Path) -> FaceReading | None:
        """A piece, if it is one of this run and whole."""
        if path.stat().st_size > _MAX_PIECE_BYTES:
            warnings.warn(
                f"{path}: found a damaged piece of {path.stat().st_size} bytes, it is made anew", stacklevel=4
            )
            return None
        tensors = read_checkpoint(path, self._piece_key())
        if tensors is None or set(tensors) != {"memory", "look", "change", *(part.name for part in _PARTS)}:
            return None
        self.memory = tensors.pop("memory")
        self._looks.append(tensors.pop("look"))
        self._changes.append(tensors.pop("change"))
        return FaceReading(**tensors)

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
