"""Names of blendshapes: ARKit's 52, what other rigs call the same shapes, and which is whose mirror image."""

import re
from collections.abc import Sequence
from difflib import get_close_matches
from functools import cache, lru_cache
from os.path import commonprefix

import torch
from torch import Tensor

ARKIT: tuple[str, ...] = (
    *("eyeBlinkLeft", "eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutLeft", "eyeLookUpLeft", "eyeSquintLeft"),
    *("eyeWideLeft", "eyeBlinkRight", "eyeLookDownRight", "eyeLookInRight", "eyeLookOutRight", "eyeLookUpRight"),
    *("eyeSquintRight", "eyeWideRight", "jawForward", "jawRight", "jawLeft", "jawOpen"),
    *("mouthClose", "mouthFunnel", "mouthPucker", "mouthRight", "mouthLeft", "mouthSmileLeft", "mouthSmileRight"),
    *("mouthFrownLeft", "mouthFrownRight", "mouthDimpleLeft", "mouthDimpleRight", "mouthStretchLeft"),
    *("mouthStretchRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper"),
    *("mouthPressLeft", "mouthPressRight", "mouthLowerDownLeft", "mouthLowerDownRight", "mouthUpperUpLeft"),
    *("mouthUpperUpRight", "browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight"),
    *("cheekPuff", "cheekSquintLeft", "cheekSquintRight", "noseSneerLeft", "noseSneerRight", "tongueOut"),
)
"""The 52 in the order in which Live Link Face writes them."""

ANTAGONISTS: tuple[tuple[str, str], ...] = (
    *(("mouthLeft", "mouthRight"), ("jawLeft", "jawRight"), ("mouthSmile", "mouthFrown"), ("cheekPuff", "cheekSuck")),
    *(("eyeLookIn", "eyeLookOut"), ("eyeLookUp", "eyeLookDown"), ("eyeBlink", "eyeWide"), ("browDown", "browOuterUp")),
)
"""Shapes that are one quantity with a sign: a face does one of the two or the other. Those with sides, on each side.

ARKit itself never has both above 0.03, in 5,538 frames of six takes; ``browDown`` goes with ``browInnerUp`` alone.
"""


_SHARED_PREFIX = re.compile(r"(?:(?!(?:l|r|left|right|fcl)[^a-z0-9])[a-z0-9]*[^a-z0-9])+", re.IGNORECASE)
_SHARED_SUFFIX = re.compile(r"(?:[^a-z0-9](?!(?:l|r|left|right)(?![a-z0-9]))[a-z0-9]+)+$", re.IGNORECASE)
_PREFIX = re.compile(
    r"^(.*__(?=facs_)|.*(?=Fcl_)(?<!^)|.*[.:|](?=[^.:|]{3,}$)|(?:facs_)?(?:bs|jnt|ctrl|cbs)_|facs_|[at]\d\d_|arkit[_ ]|"
    r"au\d+_(?=[a-z]{3})|(?:head|face|blendshapes?|bs)\d*_(?=[a-z]))",
    re.IGNORECASE,
)
_SUFFIX = re.compile(r"(_div\d+|_hd\d*|\.\d{3})$", re.IGNORECASE)
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_SIDE = {"l": "left", "r": "right", "lf": "left", "lt": "left", "rt": "right"}
_ONE_SIDE = re.compile(r"[_.]([LR])$", re.IGNORECASE)
_SPELLING = {"eyes": "eye", "brows": "brow", "eyebrow": "brow", "eyebrows": "brow", "lips": "lip"}

_SIDED = {
    "eyeBlink": (
        "Fcl_EYE_Close_*",
        "blink*",
        "Blink_*",
        "Eye_Blink_*",
        "eCTRLEyesClosed*",
        "EyeClosed*",
        "EyesClosed*",
    ),
    "eyeLookUp": ("Eye_*_Look_Up", "EyeLookUp*"),
    "eyeLookDown": ("Eye_*_Look_Down",),
    "eyeSquint": ("Eye_Squint_*",),
    "eyeWide": ("Eye_Wide_*", "EyeWiden*", "EyesWide*"),
    "browDown": ("Brow_Drop_*", "Brow_Lower_*", "BrowLowerer*"),
    "browOuterUp": ("Brow_Raise_Outer_*", "OuterBrowRaiser*", "BrowRaiseOuter*"),
    "browInnerUp": ("Brow_Raise_Inner_*", "InnerBrowRaiser*", "BrowRaiseInner*"),
    "cheekSquint": ("Cheek_Raise_*", "CheekRaiser*"),
    "cheekPuff": ("Cheek_Blow_*", "CheekBlow*"),
    "noseSneer": ("Nose_Crease_*", "NoseWrinkler*"),
    "mouthSmile": ("LipCornerPuller*", "MouthCornerPull*"),
    "mouthFrown": ("LipCornerDepressor*", "MouthCornerDepress*"),
    "mouthDimple": ("Dimpler*", "Mouth_Dimple_*"),
    "mouthStretch": ("LipStretcher*",),
    "mouthPress": ("LipPressor*",),
    "mouthUpperUp": ("Mouth_Up_Upper_*", "UpperLipRaiser*"),
    "mouthLowerDown": ("Mouth_Down_Lower_*", "LowerLipDepressor*"),
}
"""Other programs' names of shapes that have sides; ``*`` stands for the side in any spelling."""

_GAZE = {
    "eyeLookOutLeft": ("Eye_L_Look_L", "eyeLookLeftL"),
    "eyeLookInLeft": ("Eye_L_Look_R", "eyeLookRightL"),
    "eyeLookInRight": ("Eye_R_Look_L", "eyeLookLeftR"),
    "eyeLookOutRight": ("Eye_R_Look_R", "eyeLookRightR"),
}
"""Names in which an eye's side and the way it looks are distinguished by their order."""

_PLAIN = {
    "jawOpen": ("Jaw_Drop",),
    "jawForward": ("Jaw_Fwd", "JawThrust", "Jaw_Front"),
    "mouthPucker": ("LipPucker", "Mouth_Pucker_All"),
    "mouthFunnel": ("LipFunneler",),
    "mouthRollUpper": ("Mouth_Roll_In_Upper", "LipRollUpper"),
    "mouthRollLower": ("Mouth_Roll_In_Lower", "LipRollLower"),
    "tongueOut": ("Tongue_Out", "TongueStickOut", "V_Tongue_Out"),
    "cheekPuff": ("Cheek_Puff", "CheekPuffBoth"),
}
"""Other programs' names of the other shapes."""


def arkit_name(name: str) -> str | None:
    """ARKit's name of a shape that another program has named; with a side behind it for half of a shape without one.

    Example:
        >>> arkit_name("facs_bs_MouthSmileLeft_div2"), arkit_name("Mouth_Up_Upper_R"), arkit_name("viseme_aa")
        ('mouthSmileLeft', 'mouthUpperUpRight', None)
    """
    words = _words(name)
    return _table().get(words) or _table().get(tuple(sorted(words)))


def read_as_arkit(names: Sequence[str]) -> list[str]:
    """ARKit's name of each of a rig's shapes that has one, once each; the others without what all names begin or end
    with, where ARKit's shapes have it too and are read without it: in ``eye_up`` and ``eye_down`` it is what they are
    about.

    Example:
        >>> read_as_arkit(["hero_jawOpen", "hero_eyeBlink_L", "hero_earWiggle"])
        ['jawOpen', 'eyeBlinkLeft', 'earWiggle']
    """
    plain = list(names)
    start, end = commonprefix(plain), commonprefix([name[::-1] for name in names])[::-1]  # noqa: RUF071
    before, after = _SHARED_PREFIX.match(start), _SHARED_SUFFIX.search(end)
    if len(plain) > 1 and (before or after):
        first, last = before.end() if before else 0, len(after[0]) if after else 0
        short = [name[first : len(name) - last] or name for name in names]
        known = {(arkit_name(name), arkit_name(one)) for name, one in zip(names, short, strict=True)} - {(None, None)}
        if known and all(whole is None or one == whole for whole, one in known):
            plain = short
    read: list[str] = []
    for name, short_name in zip(names, plain, strict=True):
        arkit = arkit_name(name) or arkit_name(short_name)
        read.append(short_name if arkit is None or arkit in read else arkit)
    return read


def side_written_out(name: str) -> str:
    """A name that ends in the side's first letter, as Blender wants it, with the side as ARKit writes it.

    Example:
        >>> side_written_out("browDown_L"), side_written_out("jawOpen"), side_written_out("Mouth_L")
        ('browDownLeft', 'jawOpen', 'MouthLeft')
    """
    return _ONE_SIDE.sub(lambda found: _SIDE[found[1].lower()].capitalize(), name)


def _words(name: str) -> tuple[str, ...]:
    """The words of a name in lower case, sides written out; without what programs put around it."""
    previous = ""
    while previous != name:
        previous, name = name, _PREFIX.sub("", _SUFFIX.sub("", name))
    words = [word.lower() for word in _WORD.findall(name)]
    return tuple(_SPELLING.get(word, _SIDE.get(word, word)) for word in words)


@cache
def _table() -> dict[tuple[str, ...], str]:
    table: dict[tuple[str, ...], str] = {}

    def add(name: str, arkit: str) -> None:
        table.setdefault(tuple(sorted(_words(name))), arkit)

    for arkit, aliases in _GAZE.items():
        table |= {_words(alias): arkit for alias in aliases}
    for arkit in ARKIT:
        table[(arkit.lower(),)] = arkit
        add(arkit, arkit)
    for arkit in ARKIT:
        if not arkit.endswith(("Left", "Right")):
            for side in ("Left", "Right"):
                add(f"{arkit}_{side}", f"{arkit}{side}")
    for whole, sided in _SIDED.items():
        for side in ("Left", "Right"):
            for alias in sided:
                add(alias.replace("*", f"_{side}_").strip("_"), f"{whole}{side}")
    for whole, plain in _PLAIN.items():
        for alias in plain:
            add(alias, whole)
    return table


def _canonical(name: str) -> str:
    """One spelling for a shape: ``EyeBlinkLeft``, ``eyeBlink_L`` and ``eyeblinkleft`` are the same."""
    name = re.sub(r"_(L|R)$", lambda side: {"L": "Left", "R": "Right"}[side[1]], name)
    return name.lower()


@lru_cache(64)  # solvers ask for each frame
def _meanings(names: tuple[str, ...]) -> tuple[str, ...]:
    """What each is called in one spelling: other programs' names as ARKit's, where no other of the names is it."""
    meanings = [_canonical(name) for name in names]
    known, taken = {name.lower() for name in ARKIT}, set(meanings)
    for row, name in enumerate(read_as_arkit(names)):
        arkit = "" if meanings[row] in known else (arkit_name(name) or "").lower()
        whole = re.sub(r"(left|right)$", "", arkit)
        if arkit and taken.isdisjoint({arkit, *_halves(arkit), *({whole} & known)}):
            meanings[row] = arkit
            taken.add(arkit)
    return tuple(meanings)


def _halves(canonical: str) -> tuple[str, str]:
    return canonical + "left", canonical + "right"


def spelled_as(name: str, names: Sequence[str]) -> str | None:
    """How names spell a shape: the name itself if it is one of them, else the one that means the same; None if none.

    Example:
        >>> spelled_as("EyeBlinkLeft", ["jawOpen", "eyeBlink_L"])
        'eyeBlink_L'
    """
    if name in names:
        return name
    return next((other for other in names if _canonical(other) == _canonical(name)), None)


def near_names(unknown: Sequence[str], names: Sequence[str], most: int = 8) -> str:
    """What to expect in place of unknown names: the near misses among names, else the first of them.

    Example:
        >>> near_names(["jawOpne"], ["jawOpen", "mouthPucker"])
        'did you mean jawOpen?'
    """
    near = sorted({close for name in unknown for close in get_close_matches(name, names, 2)})
    return f"did you mean {' or '.join(near)}?" if near else f"{', '.join(names[:most])}, ..."


def mapping(from_names: Sequence[str], to_names: Sequence[str]) -> Tensor:
    """The matrix (N_to,N_from) that turns weights by one set of names into weights by another.

    A whole shape drives both halves of a split one; two halves give the whole their mean. Names that :func:`arkit_name`
    knows count where no other spells that shape. A name that the other side lacks leaves its row or column zero.

    Example:
        >>> mapping(["browInnerUp", "eyeBlinkLeft"], ["eyeBlink_L", "browInnerUp_L", "browInnerUp_R"]).tolist()
        [[0.0, 1.0], [1.0, 0.0], [1.0, 0.0]]
    """
    sources = {meaning: column for column, meaning in enumerate(_meanings(tuple(from_names)))}
    matrix = torch.zeros(len(to_names), len(from_names))
    for row, wanted in enumerate(_meanings(tuple(to_names))):
        whole = re.sub(r"(left|right)$", "", wanted)
        halves = [sources[half] for half in _halves(wanted) if half in sources]
        if wanted in sources:
            matrix[row, sources[wanted]] = 1.0
        elif len(halves) == 2:
            matrix[row, halves] = 0.5
        elif whole != wanted and whole in sources:
            matrix[row, sources[whole]] = 1.0
    return matrix


def arkit_sources(names: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """How a rig's shapes are called in ARKit, and which of them add up to each: ARKit's in its order, then the others.

    A shape that ARKit knows takes ARKit's spelling; two halves of what is one shape there (``browInnerUp``,
    ``cheekPuff``) are merged; a shape without a twin in ARKit keeps its name.

    Args:
        names: no name twice.

    Returns:
        For each name to write the rows of ``names`` whose deltas it is the sum of; every row occurs once.

    Example:
        >>> arkit_sources(["PupilDilate_L", "browInnerUp_L", "browInnerUp_R", "eyeBlink_L"])
        {'eyeBlinkLeft': (3,), 'browInnerUp': (1, 2), 'PupilDilate_L': (0,)}
    """
    rows: dict[str, int] = {}
    for row, name in enumerate(names):
        if name in ARKIT or _canonical(name) not in rows:  # of two spellings of one shape ARKit's own comes first
            rows[_canonical(name)] = row
    sources: dict[str, tuple[int, ...]] = {}
    for name in ARKIT:
        whole, halves = _canonical(name), _halves(_canonical(name))
        if whole in rows:
            sources[name] = (rows[whole],)
        elif all(half in rows for half in halves):
            sources[name] = (rows[halves[0]], rows[halves[1]])
    taken = {row for group in sources.values() for row in group}
    return sources | {name: (row,) for row, name in enumerate(names) if row not in taken}


def antagonists(names: Sequence[str]) -> Tensor:
    """Rows of names that are antagonists, (K,2) int64; see ``ANTAGONISTS``.

    Example:
        >>> antagonists(["jawLeft", "mouthSmile_L", "jawRight", "mouthSmile_R", "mouthFrown_L"]).tolist()
        [[0, 2], [1, 4]]
    """
    row = {meaning: i for i, meaning in enumerate(_meanings(tuple(names)))}
    pairs = [
        [row[one], row[other]]
        for first, second in ANTAGONISTS
        for one, other in (
            (first.lower(), second.lower()),
            *zip(_halves(first.lower()), _halves(second.lower()), strict=True),
        )
        if one in row and other in row
    ]
    return torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2)


def mirror(names: Sequence[str]) -> Tensor:
    """For each name the index of its mirror image, (N,) int64; a name without one is its own.

    Example:
        >>> mirror(["jawOpen", "mouthSmileLeft", "mouthSmileRight", "L_jaw", "rig.R_jaw", "rig.L_jaw"]).tolist()
        [0, 2, 1, 3, 5, 4]
    """
    words = [re.sub(r"^[ATat]\d\d_|(?<=[a-z0-9])(?=[A-Z])|[\s_.:|-]+", " ", name).lower() for name in names]
    words = [re.sub(r"\b(?:l|lf|lt|left)\b|left$", "<", name) for name in words]
    words = [re.sub(r"\b(?:r|rt|right)\b|right$", ">", name).replace(" ", "") for name in words]
    row = {name: i for i, name in enumerate(words) if "<" in name or ">" in name}
    swap = str.maketrans("<>", "><")
    return torch.tensor([row.get(name.translate(swap), i) for i, name in enumerate(words)], dtype=torch.int64)
