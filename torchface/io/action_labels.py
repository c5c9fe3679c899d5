"""Labels of a head-camera video as TOML: where to look, and which action units were performed when."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchface.errors import NameMismatchError, ValueRangeError
from torchface.files.documents import Value, read_toml

__all__ = ["ActionLabels", "Performed", "load_action_labels"]

_FORMAT = "torchface.action_labels/1"
_MAX_BYTES = 2**22
_MAX_FRAMES = 10_000_000

Box = tuple[float, float, float, float]
Pixel = tuple[float, float]


@dataclass(frozen=True)
class Performed:
    """Action units done together, from rest and back to rest.

    Args:
        units: their names, such as ``("1+2", "4")``.
        first: frame in which the motion begins.
        last: the frame before which it is over.

    Example:
        >>> frown = Performed(("4",), first=30, last=90)
        >>> frown.last - frown.first
        60
    """

    units: tuple[str, ...]
    first: int
    last: int


@dataclass(frozen=True)
class RegionGroup:
    """Regions whose features are merged, and the action units that they show.

    Args:
        name: of the group.
        regions: names of its regions.
        units: names of its action units.
        other_units: units that move the regions too but are classified by other groups: they are classes of their own,
            so that they are not taken for one of ``units``.

    Example:
        >>> forehead = RegionGroup("forehead", ("brow_left", "brow_right"), ("1+2", "4"))
        >>> forehead.other_units
        ()
    """

    name: str
    regions: tuple[str, ...]
    units: tuple[str, ...]
    other_units: tuple[str, ...] = ()


@dataclass(frozen=True)
class ActionLabels:
    """A head-camera video described.

    Args:
        frames: how many frames the video has.
        neutral: a frame in which the face is at rest; pixels below are its.
        helmet: a point of the helmet that the camera sees, (x,y).
        markers: two markers on the sides of the face, (x,y) each.
        regions: boxes (left, top, right, bottom) by name.
        performed: what was done when, in any order; empty for a video that is only to be classified.
        groups: which regions show which units, where these are others than the usual.
        offset: when the video began after the marker take, seconds.
        source: the file, for messages.

    Raises:
        ValueRangeError: a frame outside the video, an empty stretch or box, or a number that is not finite.
        NameMismatchError: a stretch without a unit, or no region.

    Example:
        >>> brows = {"brow_left": (60.0, 40.0, 90.0, 60.0)}
        >>> markers = ((20.0, 80.0), (110.0, 80.0))
        >>> ActionLabels(300, 0, (5.0, 5.0), markers, brows, (Performed(("4",), 30, 90),)).units
        ('4',)
    """

    frames: int
    neutral: int
    helmet: Pixel
    markers: tuple[Pixel, Pixel]
    regions: dict[str, Box]
    performed: tuple[Performed, ...] = ()
    groups: tuple[RegionGroup, ...] = ()
    offset: float = 0.0
    source: str = field(default="labels", compare=False)

    def __post_init__(self) -> None:
        if not 1 <= self.frames <= _MAX_FRAMES:
            raise ValueRangeError(f"{self.source}: found {self.frames} frames, expected 1 to {_MAX_FRAMES}")
        if not 0 <= self.neutral < self.frames:
            raise ValueRangeError(f"{self.source}: found neutral frame {self.neutral}, expected 0 to {self.frames - 1}")
        if not all(math.isfinite(v) for point in (self.helmet, *self.markers) for v in point):
            raise ValueRangeError(
                f"{self.source}: found helmet {self.helmet} and markers {self.markers}, expected pixels"
            )
        if not self.regions:
            raise NameMismatchError(f"{self.source}: found no region, expected at least one")
        for name, (left, top, right, bottom) in self.regions.items():
            if not (math.isfinite(left + top + right + bottom) and left + 1 < right and top + 1 < bottom):
                raise ValueRangeError(
                    f"{self.source}: region {name!r} is {(left, top, right, bottom)}, expected left < right, "
                    "top < bottom"
                )
        for stretch in self.performed:
            if not 0 <= stretch.first < stretch.last <= self.frames:
                raise ValueRangeError(
                    f"{self.source}: {' '.join(stretch.units)} is performed from frame {stretch.first} to before "
                    f"{stretch.last}, expected a stretch within the video's {self.frames} frames"
                )
            if not all(stretch.units) or not stretch.units or len(set(stretch.units)) < len(stretch.units):
                raise NameMismatchError(f"{self.source}: found the units {stretch.units!r}, expected distinct names")
        for group in self.groups:
            if not group.regions or not group.units or not set(group.regions) <= set(self.regions):
                raise NameMismatchError(
                    f"{self.source}: group {group.name!r:.60} has regions {', '.join(group.regions)} and units "
                    f"{', '.join(group.units)}, expected some of {', '.join(self.regions)}, and a unit"
                )

    @property
    def units(self) -> tuple[str, ...]:
        """Every action unit that is performed, in order of first appearance."""
        return tuple(dict.fromkeys(unit for stretch in self.performed for unit in stretch.units))


def load_action_labels(path: str | Path) -> ActionLabels:
    """Reads what a person wrote with a text editor.

    Raises:
        FileFormatError: the file is missing, too large, no TOML, or lacks a field.
        ValueRangeError, NameMismatchError: what it says cannot be; see :class:`ActionLabels`.

    Example:
        >>> from torchface.files.documents import write_toml
        >>> labels = {"format": "torchface.action_labels/1", "frames": 300, "neutral": 0, "helmet": [5, 5]}
        >>> labels |= {"markers": [[20, 80], [110, 80]], "regions": {"brow_left": [60, 40, 90, 60]}}
        >>> write_toml("take.toml", labels | {"performed": [{"units": ["4"], "first": 30, "last": 90}]})
        >>> load_action_labels("take.toml").units
        ('4',)
    """
    document = read_toml(path, _FORMAT, _MAX_BYTES)
    helmet, left, right = (
        _pixels(point) for point in (document["helmet"], *document["markers"].rows(2, 2, "two markers"))
    )
    performed = document["performed"].rows() if document["performed"] else []
    return ActionLabels(
        document["frames"].whole(),
        document["neutral"].whole(),
        helmet,
        (left, right),
        {name: _pixels(box, 4) for name, box in document["regions"].table().items()},
        tuple(
            Performed(stretch["units"].texts(), stretch["first"].whole(), stretch["last"].whole())
            for stretch in performed
        ),
        tuple(
            RegionGroup(
                group["name"].text(),
                group["regions"].texts(),
                group["units"].texts(),
                group["other_units"].texts() if group["other_units"] else (),
            )
            for group in (document["groups"].rows() if document["groups"] else [])
        ),
        document["offset"].number() if document["offset"] else 0.0,
        str(path),
    )


def _pixels(value: Value, count: int = 2) -> Any:
    return tuple(value.tensor(count, expected=f"{count} numbers").tolist())
