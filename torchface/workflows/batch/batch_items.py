"""Items of a batch: files and folders that a command works on, one by one, and their names."""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, overload

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.whole_files import visible_files
from torchface.io.mesh_files import MESH_ENDINGS
from torchface.io.rig_files import SCENE_ENDINGS
from torchface.io.take_files import MARKER_ENDINGS
from torchface.io.video.numbered_pictures import film_of_pictures
from torchface.io.video.video_file import VIDEO_ENDINGS

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

S = TypeVar("S", bound="DataclassInstance")

NAME = "{name}"  # stands in an option's path for the item's name

SCAN_ENDINGS = (*MESH_ENDINGS, *SCENE_ENDINGS)
SUMMARY, RECORDS = "summary.csv", "records"  # of a batch: its table, and the folder of its records
_OWN = (SUMMARY, RECORDS)
_BESIDE_MESHES = (".mtl", ".png", ".jpg", ".jpeg", ".tga", ".tif", ".tiff", ".bmp", ".exr", ".bin")
_NAMED = 5  # files that are left out
_KINDS = (("scan or mesh", SCAN_ENDINGS), ("marker take", MARKER_ENDINGS), ("video", VIDEO_ENDINGS))


@dataclass(frozen=True)
class BatchItem:
    """One scan, take or video."""

    name: str  # of its results and its record, without ending; no two of a batch have the same
    path: Path  # the file or folder, absolute

    @overload
    def path_of(self, path: Path) -> Path: ...

    @overload
    def path_of(self, path: None) -> None: ...

    @overload
    def path_of(self, path: Path | None) -> Path | None: ...

    def path_of(self, path: Path | None) -> Path | None:
        """A path of an option for this item: ``{name}`` in it is the item's name."""
        return None if path is None else Path(str(path).replace(NAME, self.name))

    def settings_of(self, settings: S) -> S:
        """Settings for this item: ``{name}`` in each path and text of the dataclass is the item's name."""
        changed: dict[str, Any] = {}
        for field in fields(settings):
            value = getattr(settings, field.name)
            if isinstance(value, Path):
                changed[field.name] = self.path_of(value)
            elif isinstance(value, str):
                changed[field.name] = value.replace(NAME, self.name)
            elif is_dataclass(value) and not isinstance(value, type):
                changed[field.name] = self.settings_of(value)
        return replace(settings, **changed)


@dataclass(frozen=True)
class ItemKind:
    """What a command works on."""

    noun: str  # what one is called
    done: str  # what it is afterwards, such as "registered"
    endings: tuple[str, ...]
    # Whether a file with one of the endings, or a folder, is one; every file and no folder if absent.
    is_item: Callable[[Path], bool] | None = None

    def holds(self, path: Path) -> bool:
        """Whether a file or folder is one of this kind."""
        if path.is_dir():
            return self.is_item is not None and self.is_item(path)
        if path.suffix.lower() not in self.endings or not path.is_file():
            return False
        try:
            return self.is_item is None or self.is_item(path)
        except FileFormatError:  # damaged: it is reported as one that cannot be worked on
            return True


@dataclass(frozen=True)
class FoundItems:
    """What is to be worked on, and what was left out of the folders, in words."""

    items: tuple[BatchItem, ...]
    left_out: tuple[str, ...] = ()


def is_batch(inputs: Sequence[Path], kind: ItemKind) -> bool:
    """Whether inputs are more than one item: several are named, or a folder that is none itself."""
    return len(inputs) != 1 or (inputs[0].is_dir() and not kind.holds(inputs[0]))


def find_items(inputs: Sequence[str | Path], kind: ItemKind) -> FoundItems:
    """Files as named, and for each folder the items in it, sorted by name; absolute, none twice.

    Other files in a folder are left out and named; what may belong to an item (whose name begins with the item's, and
    beside meshes their images and materials) is left alone.
    """
    files: dict[Path, None] = {}
    left_out = []
    for given in map(Path, inputs):
        if not given.is_dir() or kind.holds(given):
            files[given.resolve()] = None
            continue
        visible = [path for path in visible_files(given) if path.name not in _OWN]
        inside = [path for path in visible if kind.holds(path)]
        others = _others([path for path in visible if path not in set(inside)], inside, kind)
        expected = f"expected {kind.noun}s ({', '.join(kind.endings)})"
        if not inside:
            found_instead = f" but {others}" if others else ""
            hint = film_of_pictures(given) if kind.endings == VIDEO_ENDINGS else ""
            raise FileFormatError(f"{given}: found no {kind.noun} in the folder{found_instead}, {expected}{hint}")
        if others:
            left_out.append(f"{given}: left out {others}, {expected}")
        files |= dict.fromkeys(path.resolve() for path in inside)
    if not files:
        raise FileFormatError(f"{kind.noun}s: found none named, expected files or folders")
    paths = list(files)
    return FoundItems(tuple(map(BatchItem, _names(paths), paths)), tuple(left_out))


def check_for_each(option: str, path: Path | None) -> None:
    """Raises a ``ValueRangeError`` where items would write over each other: what each writes has its name in it."""
    if path is not None and NAME not in str(path):
        example = path.with_name(f"{NAME}{path.suffix}") if path.suffix else path / NAME
        raise ValueRangeError(
            f"{option}: found {path}, one place for the results of many; expected {NAME} in it, such as {example}"
        )


def check_folder(out: Path) -> None:
    """Raises a ``ValueRangeError`` where ``--out`` names a file, and many results need a folder."""
    if out.suffix and not out.is_dir():
        raise ValueRangeError(
            f"--out: found {out}, a file, for the results of a folder or of several inputs; expected a folder"
        )


def _others(paths: Sequence[Path], items: Sequence[Path], kind: ItemKind) -> str:
    """How many files of which other kinds there are, in words, and the names of the first."""
    found: dict[str, list[Path]] = {}
    beside = tuple(item.stem for item in items)
    of_meshes = _BESIDE_MESHES if set(MESH_ENDINGS) & set(kind.endings) else ()
    for path in paths:
        ending = path.suffix.lower()
        noun = next((noun for noun, endings in _KINDS if ending in endings and ending not in kind.endings), "")
        if not noun and path.is_file():
            belongs = path.stem.startswith(beside) or ending in of_meshes
            noun = f"file that holds no {kind.noun}" if ending in kind.endings else "" if belongs else "other file"
        if noun:
            found.setdefault(noun, []).append(path)
    order = [*(noun for noun, _ in _KINDS), f"file that holds no {kind.noun}", "other file"]
    counts = [(noun, len(found[noun])) for noun in order if noun in found]
    names = [path.name for noun, _ in counts for path in found[noun]]
    words = " and ".join(f"{count} {_plural(noun) if count > 1 else noun}" for noun, count in counts)
    return f"{words} ({', '.join(names[:_NAMED])}{', ...' if len(names) > _NAMED else ''})" if words else ""


def _plural(noun: str) -> str:
    return {"scan or mesh": "scans or meshes"}.get(
        noun, noun.replace("file that holds", "files that hold") if " holds " in noun else f"{noun}s"
    )


def _names(files: Sequence[Path]) -> list[str]:
    """A name each, none twice: the file's, with its folder's or its ending's where others have the same."""
    ways: tuple[Callable[[Path], str], ...] = (
        lambda path: path.stem,
        lambda path: f"{path.parent.name}_{path.stem}",
        lambda path: f"{path.parent.name}_{path.stem}_{path.suffix[1:]}",
        lambda path: f"{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}",
    )
    names = [ways[0](path) for path in files]
    for way in ways[1:]:
        # Some file systems do not distinguish upper from lower case.
        count = Counter(name.lower() for name in names)
        names = [way(path) if count[name.lower()] > 1 else name for name, path in zip(names, files, strict=True)]
    return names
