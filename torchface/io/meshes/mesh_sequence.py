"""Many meshes of one topology in one file, read a few at a time: a safetensors file whose numbers stay on disk."""

import hashlib
import json
import os
import time
import warnings
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np
from safetensors import SafetensorError, safe_open
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError, TopologyError, ValueRangeError
from torchface.files.documents import read_json, write_json
from torchface.files.temporary_files import open_plain
from torchface.files.whole_files import sync_folder
from torchface.files.write_errors import unwritten
from torchface.number_checks import check_rate

FORMAT = "torchface.mesh-sequence/1"
_MAX_COUNT = 2**31
_NOTE_SECONDS = 1.0
_BLOCK = 2**22
_UNKNOWN = "0" * 64  # in place of the numbers' hash, until all are written


class MeshSequence:
    """Vertices (M,V,C) float32 on disk, mapped into memory as they are read; ``faces``, the writer's ``key``, ``fps``.

    Args:
        path: what a :class:`MeshSequenceWriter` wrote; any safetensors file with ``vertices`` and ``faces`` will do.

    Raises:
        FileFormatError: the file is missing, cut off, or holds something else.

    Example:
        >>> with MeshSequenceWriter("take.safetensors", count=2, vertices=3, faces=torch.tensor([[0, 1, 2]])) as writer:
        ...     writer.append(torch.eye(3).repeat(2, 1, 1))
        >>> frames = MeshSequence("take.safetensors")
        >>> frames.read(1, 2).tolist() == [torch.eye(3).tolist()], frames.is_whole()
        (True, True)
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise FileFormatError(f"{self.path}: found no such file, expected a mesh sequence")
        try:
            with safe_open(self.path, framework="pt") as file:
                names = set(file.keys())
                metadata = file.metadata() or {}
                self.key: str = metadata.get("key", "")
                self._content: str | None = metadata.get("content")
                rate = metadata.get("fps")
                self.fps = None if rate is None else check_rate(float(rate), str(self.path))
                if not {"vertices", "faces"} <= names:
                    raise FileFormatError(f"{self.path}: found {sorted(names)[:5]}, expected vertices and faces")
                vertices, faces = file.get_slice("vertices"), file.get_slice("faces")
                self.shape = tuple(vertices.get_shape())
                kinds, face_shape = (vertices.get_dtype(), faces.get_dtype()), faces.get_shape()
                right = kinds == ("F32", "I64") and len(self.shape) == 3 and len(face_shape) == 2 and face_shape[1] == 3
                if not right or 0 in self.shape:
                    raise FileFormatError(
                        f"{self.path}: found vertices {kinds[0]} {self.shape} and faces {kinds[1]} "
                        f"{tuple(face_shape)}, expected F32 (M,V,C) and I64 (F,3)"
                    )
                self.faces: Tensor = file.get_tensor("faces")
        except (SafetensorError, OSError, ValueError) as error:
            raise FileFormatError(f"{self.path}: no mesh sequence ({error})") from error
        if self.faces.numel() and not 0 <= int(self.faces.min()) <= int(self.faces.max()) < self.shape[1]:
            raise FileFormatError(f"{self.path}: found faces of vertices beyond the {self.shape[1]} there are")

    def __len__(self) -> int:
        return self.shape[0]

    def read(self, begin: int, end: int) -> Tensor:
        """Meshes ``begin`` to ``end``, without the last, (N,V,C).

        Raises:
            FileFormatError: the file is gone or has changed.
        """
        try:
            # Opened anew each time: pages of a mapping that is closed leave the memory.
            with safe_open(self.path, framework="pt") as file:
                part: Tensor = file.get_slice("vertices")[begin:end].clone()
        except (SafetensorError, OSError, ValueError) as error:
            raise FileFormatError(f"{self.path}: cannot be read ({error})") from error
        if part.shape[1:] != self.shape[1:]:
            raise FileFormatError(f"{self.path}: found meshes of {tuple(part.shape[1:])}, expected {self.shape[1:]}")
        return part

    def is_whole(self) -> bool:
        """Whether the vertices are those that were written; a file that holds no hash of them is believed.

        Raises:
            FileFormatError: the file cannot be read.
        """
        if self._content is None:
            return True
        try:
            with self.path.open("rb") as file:
                size = 4 * int(np.prod(self.shape, dtype=np.int64))
                file.seek(-size, os.SEEK_END)
                return _hashed(file, size).hexdigest() == self._content
        except OSError as error:
            raise FileFormatError(f"{self.path}: cannot be read ({error})") from error


class MeshSequenceWriter:
    """Writes a mesh sequence mesh by mesh; the file appears when it is complete, and a killed run continues.

    What is unfinished lies beside as ``NAME.part``, with the count and the hash of its meshes in ``NAME.part.json``. A
    writer with the same sizes and ``key`` goes on behind them if they are as they were written: ``done`` says where. A
    process that is killed loses a second's meshes at most.

    Args:
        path: of the file; its folder must be there.
        count: how many meshes there will be.
        vertices: of each.
        faces: triangles (F,3) int64 that all share.
        channels: numbers a vertex.
        key: says what the meshes are made of; another key begins anew.
        fps: frames a second, where the meshes are an animation.

    Raises:
        FileFormatError: the file cannot be written.
        ValueRangeError: ``fps`` is no rate.

    Example:
        >>> writer = MeshSequenceWriter("take.safetensors", count=2, vertices=3, faces=torch.tensor([[0, 1, 2]]))
        >>> writer.append(torch.eye(3))
        >>> writer.done
        1
    """

    def __init__(
        self,
        path: str | Path,
        count: int,
        vertices: int,
        faces: Tensor,
        channels: int = 3,
        key: str = "",
        fps: float | None = None,
    ) -> None:
        if not (0 < count < _MAX_COUNT and vertices > 0 and channels > 0):
            raise ShapeError(f"mesh sequence: found {count} meshes of ({vertices},{channels}), expected at least one")
        self.path, self.count, self.mesh_shape = Path(path), count, (vertices, channels)
        self._part = self.path.with_name(f"{self.path.name}.part")
        self._note = self.path.with_name(f"{self.path.name}.part.json")
        numbers = faces.detach().cpu().contiguous().numpy().astype("<i8").tobytes()
        size = 4 * count * vertices * channels
        rate = {} if fps is None else {"fps": repr(check_rate(fps, "mesh sequence", ValueRangeError))}
        header = json.dumps(
            {
                "__metadata__": {"format": FORMAT, "key": key, **rate, "content": _UNKNOWN},
                "faces": {"dtype": "I64", "shape": list(faces.shape), "data_offsets": [0, len(numbers)]},
                "vertices": {
                    "dtype": "F32",
                    "shape": [count, vertices, channels],
                    "data_offsets": [len(numbers), len(numbers) + size],
                },
            }
        ).encode()
        header += b" " * (-len(header) % 8)
        self._content_at = 8 + header.rindex(_UNKNOWN.encode())
        self._begin = len(header).to_bytes(8, "little") + header + numbers
        self._hash = hashlib.sha256()
        self.done = self._finished()
        try:
            if self.done == 0:
                self._note.unlink(missing_ok=True)  # first: it would be one of other meshes
                self._part.unlink(missing_ok=True)
                self._file = os.fdopen(open_plain(self._part, os.O_RDWR | os.O_CREAT | os.O_EXCL), "r+b")
                self._file.write(self._begin)
            else:
                self._file = os.fdopen(open_plain(self._part, os.O_RDWR), "r+b")
            self._file.seek(self._offset(self.done))
        except OSError as error:
            raise unwritten(self.path, error) from error
        self._noted = 0.0

    def append(self, vertices: Tensor) -> None:
        """Adds one mesh (V,C) or several (N,V,C).

        Raises:
            TopologyError: they have other vertices than the rest.
            ShapeError: there are more than were announced.
            FileFormatError: the disk is full.
        """
        several = vertices if vertices.ndim == 3 else vertices[None]
        if several.shape[1:] != self.mesh_shape:
            raise TopologyError(f"mesh sequence: found {tuple(several.shape[1:])}, expected {self.mesh_shape}")
        if self.done + len(several) > self.count:
            raise ShapeError(f"mesh sequence: found more than the {self.count} meshes announced")
        try:
            data = several.detach().cpu().contiguous().numpy().astype("<f4", copy=False).tobytes()
            self._file.write(data)
            self._file.flush()
        except OSError as error:
            raise unwritten(self.path, error) from error
        self._hash.update(data)
        self.done += len(several)
        if time.monotonic() - self._noted > _NOTE_SECONDS:  # a disk takes longer to be sure than a mesh takes
            self._note_done()

    def close(self) -> None:
        """Puts a complete file in its place; what is incomplete stays beside for another run."""
        if self._file.closed:
            return
        try:
            with self._file:
                self._note_done()
                if self.done == self.count:
                    self._file.seek(self._content_at)
                    self._file.write(self._hash.hexdigest().encode())
                    self._file.flush()
                    os.fsync(self._file.fileno())
            if self.done == self.count:
                os.replace(self._part, self.path)
                sync_folder(self.path.parent)
                self._note.unlink(missing_ok=True)
        except OSError as error:
            raise unwritten(self.path, error) from error

    def _note_done(self) -> None:
        """Notes what is there for another run, once it is on the disk."""
        self._file.flush()
        os.fsync(self._file.fileno())
        write_json(self._note, {"done": self.done, "sha256": self._hash.hexdigest()}, indent=None)
        self._noted = time.monotonic()

    def __enter__(self) -> "MeshSequenceWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _offset(self, meshes: int) -> int:
        return len(self._begin) + 4 * meshes * int(np.prod(self.mesh_shape))

    def _finished(self) -> int:
        """How many meshes an earlier run of the same kind has written; those whose bytes have changed since are
        named in a warning and begun anew."""
        if not (self._part.is_file() and self._note.is_file()):
            return 0
        try:
            note = read_json(self._note)
            done = note["done"].whole(0, self.count)
            with self._part.open("rb") as file:
                begin, after = file.read(len(self._begin)), self._content_at + len(_UNKNOWN)
                # Killed between the last write and the rename it holds the content's hash already.
                if (begin[: self._content_at], begin[after:]) != (self._begin[: self._content_at], self._begin[after:]):
                    return 0
                content = _hashed(file, self._offset(done) - len(self._begin))
            if content.hexdigest() != note["sha256"].found:
                raise FileFormatError(f"{self._part}: found other meshes than were written")
        except (OSError, FileFormatError) as error:
            warnings.warn(f"{error}; the meshes of {self.path.name} are written anew", stacklevel=4)
            return 0
        self._hash = content
        return done


def _hashed(file: BinaryIO, size: int) -> "hashlib._Hash":
    """The hash of the next bytes of a file, of fewer where it ends."""
    digest = hashlib.sha256()
    while size > 0 and (block := file.read(min(size, _BLOCK))):
        digest.update(block)
        size -= len(block)
    return digest
