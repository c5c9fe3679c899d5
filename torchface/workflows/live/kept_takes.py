"""Takes in a folder: listed, renamed, deleted and read for the page."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from torchface.errors import FileFormatError
from torchface.files.documents import parse_json
from torchface.files.whole_files import delete_file, read_file, write_file
from torchface.io.weights.live_link_csv import load_live_link
from torchface.io.weights.weight_csv import ROTATIONS

WEIGHTS, LIVE_LINK, ANIMATION, SUMMARY = "weights.csv", "live_link.csv", "animation.glb", "summary.json"

_FIRST = "first"  # what the take in the folder itself is called in addresses
_LARGEST_SUMMARY, _LONGEST_NAME = 2**16, 60
_MOST = 500


@dataclass(frozen=True)
class KeptTake:
    """A take on the disk.

    Args:
        place: its folder's name; ``first`` for the one in the folder itself.
        name: for people.
        seconds, frames: how long it is.
    """

    place: str
    name: str
    seconds: float
    frames: int

    def fields(self) -> dict[str, Any]:
        """For the page."""
        return {"id": self.place, "name": self.name, "seconds": self.seconds, "frames": self.frames}


def kept_takes(folder: Path) -> list[KeptTake]:
    """The takes in a folder, newest first."""
    found: list[tuple[float, KeptTake]] = []
    with suppress(OSError):
        for place in [folder, *sorted(path for path in folder.glob("*/") if path.is_dir())][:_MOST]:
            if (place / SUMMARY).is_file():
                with suppress(FileFormatError, ValueError, TypeError, KeyError):
                    facts = _summary(place)
                    name = _FIRST if place == folder else place.name
                    take = KeptTake(
                        name, str(facts.get("name", place.name)), float(facts["seconds"]), int(facts["frames"])
                    )
                    found.append(((place / SUMMARY).stat().st_mtime, take))
    return [take for _, take in sorted(found, key=lambda one: -one[0])]


def rename_take(folder: Path, place: str, name: str) -> None:
    """Gives a take another name for people; its folder stays.

    Raises:
        FileFormatError: there is no such take, or its summary cannot be written.
    """
    path = _place(folder, place)
    changed = {**_summary(path), "name": "".join(c for c in name if c.isprintable())[:_LONGEST_NAME] or path.name}
    write_file(path / SUMMARY, json.dumps(changed, indent=1).encode())


def remove_take(folder: Path, place: str) -> None:
    """Deletes a take's files, and its folder where nothing else is in it.

    Raises:
        FileFormatError: there is no such take, or it cannot be deleted.
    """
    path = _place(folder, place)
    for name in (SUMMARY, WEIGHTS, LIVE_LINK, ANIMATION):
        if (path / name).exists():
            delete_file(path / name)
    with suppress(OSError):
        path.rmdir()


def take_rows(folder: Path, place: str) -> bytes:
    """A take for the page: little-endian floats, rows of seconds, weights (52), rotation (9) and gaze (4).

    Raises:
        FileFormatError: there is no such take, or it cannot be read.
    """
    path = _place(folder, place)
    take = load_live_link(path / LIVE_LINK)
    columns = take.extras["columns"]
    angles = torch.stack([columns[name] for name in ROTATIONS], 1).double().numpy()
    head = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("YXZ", angles[:, :3]).as_matrix()
    gaze = -angles[:, [6, 7, 3, 4]]  # the right eye first, to the person's left and up
    assert take.weights is not None
    seconds = take.times.numpy()
    rows = np.column_stack([seconds - seconds[0], take.weights.values[..., 0].numpy(), head.reshape(-1, 9), gaze])
    return rows.astype("<f4").tobytes()


def _place(folder: Path, place: str) -> Path:
    if place not in {take.place for take in kept_takes(folder)}:
        raise FileFormatError(f"{folder}: found no take {place[:60]!r}, expected one of the list")
    return folder if place == _FIRST else folder / place


def _summary(place: Path) -> dict[str, Any]:
    found = parse_json(read_file(place / SUMMARY, _LARGEST_SUMMARY))
    if not isinstance(found, dict):
        raise FileFormatError(f"{place / SUMMARY}: found no summary, expected that of a take")
    return found
