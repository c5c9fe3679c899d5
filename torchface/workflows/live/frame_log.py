"""Frames of weights written to the disk as they come, and read back as one take."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.files.temporary_files import new_temporary
from torchface.files.write_errors import unwritten
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.take import Take, Track

_EVEN = 1e-6  # seconds by which times that are even may be off


class FrameLog:
    """A temporary file in a folder, a row of numbers a frame; it goes when the log is closed.

    Args:
        folder: where there is room; it must exist.
        names: of the weights, (N,).

    Raises:
        FileFormatError: the folder cannot be written to.
    """

    def __init__(self, folder: Path, names: tuple[str, ...]) -> None:
        self.names, self.count = names, 0
        numbers = (len(names),), (len(ROTATIONS),)
        self._row = np.dtype([("weights", "<f4", *numbers[:1]), ("rotations", "<f4", *numbers[1:]), ("time", "<f8")])
        self._first = 0.0
        try:
            handle, self._path = new_temporary(folder / "frames")
        except OSError as error:
            raise unwritten(folder, error) from error
        self._file = os.fdopen(handle, "r+b", buffering=2**18)

    def append(self, came: float, weights: Tensor, rotations: Tensor) -> None:
        """Adds a frame: when it came in seconds of any clock, weights (N,), rotations (9,).

        Raises:
            FileFormatError: the disk is full.
        """
        if self.count == 0:
            self._first = came
        row = np.zeros(1, self._row)
        row["weights"], row["rotations"] = weights.detach().cpu().numpy(), rotations.detach().cpu().numpy()
        row["time"] = came - self._first
        try:
            self._file.write(row.tobytes())
        except OSError as error:
            raise unwritten(self._path, error) from error
        self.count += 1  # last: of a frame at which an interrupt came in between nothing is read

    def take(self, fps: float) -> Take:
        """The frames, as they lie on the disk: valid until the log is closed.

        Args:
            fps: where times do not say: of a single frame.

        Raises:
            ValueRangeError: there is none.
        """
        if self.count == 0:
            raise ValueRangeError("recording: found no frame, expected at least one")
        self._file.flush()
        rows = np.memmap(self._path, self._row, "c", shape=(self.count,))
        seconds = torch.from_numpy(rows["time"].copy())
        angles = torch.from_numpy(rows["rotations"].astype(np.float64))
        columns = {name: angles[:, i].clone() for i, name in enumerate(ROTATIONS)}
        track = Track(self.names, torch.from_numpy(rows["weights"])[..., None])
        if self.count > 1:
            fps = (self.count - 1) / float(seconds[-1])
            even = torch.arange(self.count).double() / round(fps, 3)
            if float((even - seconds).abs().max()) <= _EVEN:
                return Take(round(fps, 3), weights=track, extras={"columns": columns})
        return Take(fps, weights=track, extras={"columns": columns, "seconds": seconds})

    def close(self) -> None:
        """Deletes the file."""
        with suppress(OSError):  # of what could not be written nothing is kept
            self._file.close()
        with suppress(OSError):
            self._path.unlink()

    def __enter__(self) -> FrameLog:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()
