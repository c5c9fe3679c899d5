"""ARKit's shapes under the names that other programs give them: one table of aliases, and a reading by words."""

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from torchface.shape_names.arkit_names import ARKIT, arkit_name, mapping, read_as_arkit
from torchface.shape_names.name_tables import METAHUMAN, VRM1
from torchface.shape_names.pose_names import posed_weights

_VOWEL = re.compile(r"(?:fcl_mth_|vrc[._]v_)(a|i|u|e|o|aa|ih|ou|oh)", re.IGNORECASE)
_CLIPS = {"a": "aa", "i": "ih", "u": "ou", "e": "ee", "o": "oh"}
_MOODS = {
    "fcl_mth_fun": {"mouthSmileLeft": 0.5, "mouthSmileRight": 0.5},
    "fcl_mth_down": {"mouthFrownLeft": 0.5, "mouthFrownRight": 0.5},
    "fcl_brw_angry": {"browDownLeft": 0.5, "browDownRight": 0.5},
    "fcl_brw_surprised": {"browInnerUp": 0.5, "browOuterUpLeft": 0.25, "browOuterUpRight": 0.25},
    "fcl_eye_surprised": {"eyeWideLeft": 0.5, "eyeWideRight": 0.5},
}
"""What VRoid's shapes for moods are of ARKit's."""


@dataclass(frozen=True)
class RecognisedShape:
    """One of ARKit's shapes among a rig's.

    Args:
        rows: of the rig's names, whose sum it is: one, or two halves.
        names: those names.
        as_arkit: it is spelled as ARKit spells it.
    """

    rows: tuple[int, ...]
    names: tuple[str, ...]
    as_arkit: bool


def recognised_shapes(names: Sequence[str]) -> dict[str, RecognisedShape]:
    """Which of ARKit's 52 a rig has, however it calls them, in ARKit's order.

    ARKit's own spelling counts before others; of MetaHuman's curves those that :data:`METAHUMAN` joins. Poses of
    several shapes (VRM's ``happy``, visemes) are none of the 52.

    Args:
        names: a rig's.

    Example:
        >>> found = recognised_shapes(["A25_Jaw_Open", "Fcl_EYE_Close_L", "browInnerUp_L", "browInnerUp_R", "Fcl_Joy"])
        >>> for name, shape in found.items():
        ...     print(name, *shape.names)
        eyeBlinkLeft Fcl_EYE_Close_L
        jawOpen A25_Jaw_Open
        browInnerUp browInnerUp_L browInnerUp_R
    """
    backwards = [*enumerate(names)][::-1]  # of two alike the first stays
    row = {name: number for number, name in backwards}
    read = read_as_arkit(names)
    by_words = {arkit: number for number, _ in backwards if (arkit := arkit_name(read[number])) is not None}
    found: dict[str, RecognisedShape] = {}
    for arkit in ARKIT:
        rows: tuple[int, ...] = ()
        if arkit in row:
            rows = (row[arkit],)
        elif arkit in by_words:
            rows = (by_words[arkit],)
        elif f"{arkit}Left" in by_words and f"{arkit}Right" in by_words:
            rows = (by_words[f"{arkit}Left"], by_words[f"{arkit}Right"])
        elif all(curve in row for curve in METAHUMAN.twins.get(arkit, ("",))):
            rows = tuple(row[curve] for curve in METAHUMAN.twins[arkit])
        if rows:
            found[arkit] = RecognisedShape(rows, tuple(names[i] for i in rows), arkit in row)
    return found


def recognised_mapping(from_names: Sequence[str], to_names: Sequence[str]) -> Tensor:
    """The matrix (N_to,N_from) of :func:`mapping`, which also matches other programs' names of ARKit's shapes,
    MetaHuman's curves, names of a rig whose names all begin or end with something, where ARKit's are among them, and of
    the source action units and MikuMikuDance's morphs; to what ``mapping`` leaves alone.

    Example:
        >>> names = ["Head.jawOpen_Mesh", "Head.eyeBlink_L_Mesh"]
        >>> recognised_mapping(["eyeBlinkLeft", "jawOpen"], names).tolist()
        [[0.0, 1.0], [1.0, 0.0]]
    """
    matrix = mapping(from_names, to_names)
    joined = {curve for curves in METAHUMAN.twins.values() for curve in curves}  # by the table, each with others
    apart = [[one != other and not joined.isdisjoint((one, other)) for one in from_names] for other in to_names]
    matrix[torch.tensor(apart, dtype=torch.bool).reshape(matrix.shape)] = 0.0
    ours, theirs = read_as_arkit(from_names), read_as_arkit(to_names)
    copies = torch.zeros(len(to_names), len(from_names))
    for arkit, curves in METAHUMAN.twins.items():
        to_curves = [row for row, name in enumerate(to_names) if name in curves]
        from_curves = [column for column, name in enumerate(from_names) if name in curves]
        if to_curves and arkit in ours:
            copies[to_curves, ours.index(arkit)] = 1.0
        if from_curves and arkit in theirs:
            copies[theirs.index(arkit), from_curves] = 1 / len(from_curves)
    steps = [copies, mapping(ours, theirs)]
    poses = posed_weights(from_names)
    if poses.any():
        steps.append(recognised_mapping(ARKIT, to_names) @ poses)
    for step in steps:  # of two shapes for one motion the first alone moves
        free = ~matrix.any(1, keepdim=True) & ~matrix.any(0, keepdim=True)
        matrix = torch.where(free, step, matrix)
    return matrix


def arkit_count(found: Collection[str], still: Sequence[str]) -> str:
    """How many of ARKit's 52 shapes a rig has, for people to read; those that move nothing do not count."""
    moves = "moves" if len(still) == 1 else "move"
    return f"{len(found)} of ARKit's 52" + (f" (its {', '.join(still)} {moves} nothing)" if still else "")


def vowel_sources(name: str) -> dict[str, float]:
    """What a vowel's shape of VRoid or VRChat, or VRoid's for a mood, takes of ARKit's weights; limits are 0 and 1.

    For characters that open their mouth by vowels alone. Vowels are VRM's clips (``VRM1``).
    """
    plain = name[max(0, name.find("Fcl_")) :].lower()
    vowel = _VOWEL.fullmatch(plain)
    return _vowels()[_CLIPS.get(vowel[1], vowel[1])] if vowel else _MOODS.get(plain, {})


@cache
def _vowels() -> dict[str, dict[str, float]]:
    return VRM1.factors(tuple(_CLIPS.values()))
