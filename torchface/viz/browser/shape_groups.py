"""Which part of the face a blendshape belongs to, by its name."""

from __future__ import annotations

import re
from collections.abc import Sequence

from torchface.shape_names import mirror

GROUPS = ("brows", "eyes", "jaw", "mouth", "cheeks", "nose", "other")
"""The field's groups, top of the panel first."""

_PREFIXES = {"brow": "brows", "eye": "eyes", "jaw": "jaw", "mouth": "mouth", "cheek": "cheeks", "nose": "nose"}


def group_of(name: str) -> str:
    """The group of one shape.

    Example:
        >>> [group_of(name) for name in ("browInnerUp_L", "EyeBlinkLeft", "tongueOut")]
        ['brows', 'eyes', 'other']
    """
    lowered = name.lower()
    return next((group for prefix, group in _PREFIXES.items() if lowered.startswith(prefix)), "other")


def grouped(names: Sequence[str]) -> dict[str, list[int]]:
    """Rows of ``names`` by group, groups without a shape left out, mirror twins side by side.

    Example:
        >>> grouped(["mouthSmileLeft", "jawOpen", "mouthPucker", "mouthSmileRight"])
        {'jaw': [1], 'mouth': [0, 3, 2]}
    """
    twins = mirror(names).tolist()
    order: dict[int, None] = {}
    for row, twin in enumerate(twins):
        order.setdefault(row)
        order.setdefault(twin)
    members = {group: [row for row in order if group_of(names[row]) == group] for group in GROUPS}
    return {group: rows for group, rows in members.items() if rows}


def label_of(name: str) -> str:
    """A shape's name as it fits beside its slider, inside its group: without the group, sides as one letter.

    Example:
        >>> [label_of(name) for name in ("mouthLowerDownRight", "browInnerUp_L", "jawLeft", "jawOpen", "tongueOut")]
        ['LowerDown R', 'InnerUp L', 'Left', 'Open', 'tongueOut']
    """
    prefix = next((prefix for prefix in _PREFIXES if name.lower().startswith(prefix)), "")
    rest = name[len(prefix) :].lstrip("_") or name
    return re.sub(r"(?<=.)(?:_|(?<=[a-z])(?=[LR]))(L|R)(?:eft|ight)?$", r" \1", rest)
