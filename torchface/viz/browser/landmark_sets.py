"""Sets of landmarks with their names, and which is whose mirror image."""

from collections.abc import Sequence
from dataclasses import dataclass

from torchface.errors import NameMismatchError
from torchface.landmarks.images.ibug_68 import MIRROR_68


@dataclass(frozen=True)
class LandmarkSet:
    """Landmarks in their order."""

    names: tuple[str, ...]  # one a landmark; left and right are the performer's own
    mirror: tuple[int, ...]  # for each its mirror image's row; a midline landmark names itself


def _numbered(part: str, count: int) -> list[str]:
    return [f"{part} {i}" for i in range(1, count + 1)]


IBUG_68 = LandmarkSet(
    (
        *_numbered("jaw line", 17),
        *_numbered("right brow", 5),
        *_numbered("left brow", 5),
        *_numbered("nose bridge", 4),
        *_numbered("nose base", 5),
        *_numbered("right eye", 6),
        *_numbered("left eye", 6),
        *_numbered("outer lip", 12),
        *_numbered("inner lip", 8),
    ),
    MIRROR_68,
)
"""iBUG's 68 in their order, which begins at the performer's right ear."""

THESIS_12 = LandmarkSet(
    (
        *("nose tip", "between the eyes", "right eye outer corner", "right eye inner corner"),
        *("left eye inner corner", "left eye outer corner", "right cheek", "left cheek"),
        *("right mouth corner", "left mouth corner", "top of mouth", "bottom of mouth"),
    ),
    (0, 1, 5, 4, 3, 2, 7, 6, 9, 8, 10, 11),
)
"""The twelve of the thesis, section 3.2.2."""


def custom_set(names: Sequence[str]) -> LandmarkSet:
    """A set of the user's own names; a name with ``left`` in it mirrors the one with ``right`` there instead.

    Example:
        >>> custom_set(["chin", "left ear", "right ear"]).mirror
        (0, 2, 1)
    """
    if len(set(names) - {"", "next"}) < len(names):
        raise NameMismatchError(f"names: found {', '.join(map(repr, names))}, expected each once, none empty or 'next'")
    row = {name: i for i, name in enumerate(names)}
    swap = str.maketrans({"\0": "right", "\1": "left"})
    twins = (name.replace("left", "\0").replace("right", "\1").translate(swap) for name in names)
    return LandmarkSet(tuple(names), tuple(row.get(twin, i) for i, twin in enumerate(twins)))
