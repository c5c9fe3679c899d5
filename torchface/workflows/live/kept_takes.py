"""Takes in a folder: listed, renamed, deleted and read for the page."""

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.documents import parse_json
from torchface.files.whole_files import delete_file, read_file, write_file
from torchface.io.weights.live_link_csv import load_live_link
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT, mapping
from torchface.take import Take
from torchface.workflows.head_rotations import head_rotations
from torchface.workflows.live.take_film import FILM

WEIGHTS, LIVE_LINK, ANIMATION, SUMMARY = "weights.csv", "live_link.csv", "animation.glb", "summary.json"

_FIRST = "first"  # what the take in the folder itself is called in addresses
_LARGEST_SUMMARY, _LONGEST_NAME = 2**16, 60
_MOST = 500


@dataclass(frozen=True)
class KeptTake:
    """A take on the disk."""

    place: str  # its folder's name; `first` for the one in the folder itself
    name: str  # for people
    # seconds, frames: how long it is
    seconds: float
    frames: int
    filmed: bool = False  # whether the camera's film is kept

    def fields(self) -> dict[str, Any]:
        """For the page."""
        film = Path(FILM).suffix if self.filmed else ""
        facts = {"id": self.place, "name": self.name, "seconds": self.seconds, "frames": self.frames}
        return {**facts, "film": film, "solvable": self.filmed}


def kept_takes(folder: Path) -> list[KeptTake]:
    """The takes in a folder, newest first."""
    found: list[tuple[float, KeptTake]] = []
    with suppress(OSError):
        for place in [folder, *sorted(path for path in folder.glob("*/") if path.is_dir())][:_MOST]:
            if (place / SUMMARY).is_file():
                with suppress(FileFormatError, ValueError, TypeError, KeyError):
                    facts = _summary(place)
                    name = _FIRST if place == folder else place.name
                    number = "1" if place == folder else place.name.removeprefix("take_")
                    called, filmed = str(facts.get("name", f"Take {number}")), (place / FILM).is_file()
                    take = KeptTake(name, called, float(facts["seconds"]), int(facts["frames"]), filmed)
                    found.append(((place / SUMMARY).stat().st_mtime, take))
    return [take for _, take in sorted(found, key=lambda one: -one[0])]


def rename_take(folder: Path, place: str, name: str) -> None:
    """Gives a take another name for people; its folder stays."""
    path = _place(folder, place)
    changed = {**_summary(path), "name": printable(name) or path.name}
    write_file(path / SUMMARY, json.dumps(changed, indent=1).encode())


def remove_take(folder: Path, place: str) -> None:
    """Deletes a take's files, and its folder where nothing else is in it."""
    path = _place(folder, place)
    for name in (SUMMARY, WEIGHTS, LIVE_LINK, ANIMATION, FILM):
        if (path / name).exists():
            delete_file(path / name)
    with suppress(OSError):
        path.rmdir()


def printable(name: str) -> str:
    """A name without what cannot be shown, and not too long."""
    return "".join(c for c in name if c.isprintable())[:_LONGEST_NAME]


def take_file(folder: Path, place: str) -> bytes:
    """A take for the page: little-endian floats, see :func:`take_rows`; its film where ``/film`` ends the name."""
    if place.endswith("/film"):
        return read_file(film_of(folder, place.removesuffix("/film")))
    return take_rows(load_live_link(_place(folder, place) / LIVE_LINK)).numpy().astype("<f4").tobytes()


def film_of(folder: Path, place: str) -> Path:
    """The camera's film of a take."""
    return _place(folder, place) / FILM


def take_rows(take: Take) -> Tensor:
    """A take's rows (T,66): seconds, ARKit's weights (52), rotation (9) and gaze (4)."""
    names = () if take.weights is None else take.weights.names
    shapes = mapping(names, ARKIT)
    if take.weights is None or not shapes.any():
        raise FileFormatError("take: found no weights by ARKit's names, expected some")
    columns, still = take.extras.get("columns", {}), torch.zeros(len(take))
    angles = torch.stack([torch.as_tensor(columns.get(name, still)) for name in ROTATIONS], 1).double().nan_to_num(0.0)
    gaze = -angles[:, [6, 7, 3, 4]]  # the right eye first, to the person's left and up
    weights = (take.weights.values[..., 0].float() @ shapes.T).nan_to_num(0.0).clamp(0, 1)
    seconds = (take.times - take.times[0])[:, None]
    return torch.cat([seconds, weights.double(), head_rotations(angles[:, :3]).flatten(1), gaze], 1)


def _place(folder: Path, place: str) -> Path:
    if place not in {take.place for take in kept_takes(folder)}:
        raise FileFormatError(f"{folder}: found no take {place[:60]!r}, expected one of the list")
    return folder if place == _FIRST else folder / place


def _summary(place: Path) -> dict[str, Any]:
    found = parse_json(read_file(place / SUMMARY, _LARGEST_SUMMARY))
    if not isinstance(found, dict):
        raise FileFormatError(f"{place / SUMMARY}: found no summary, expected that of a take")
    return found
