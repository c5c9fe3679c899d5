"""Matching of a take's labels with an attachment's markers, as recorders write labels."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torchface.errors import NameMismatchError
from torchface.escaped_text import listed

_UNLABELLED = re.compile(r"\*\d*|un(label?led|named|known)[\s_*-]*\d*", re.IGNORECASE)
_LEFT = re.compile(r"left|Left|LEFT|(?:^|(?<![A-Za-z])|(?<=[a-z]))L|(?:^|(?<![A-Za-z]))l|[Ll]$")
_RIGHT = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "L": "R", "l": "r"}


@dataclass(frozen=True)
class LabelMatch:
    """A take's labels matched to an attachment's.

    Args:
        channels: of the take's labels, those that are markers of the attachment.
        labels: the attachment's label of each of them.
        unmatched: the take's labels that are none of the attachment's.

    Example:
        >>> match = match_labels(["Actor:M001", "elbow"], ["M001"])
        >>> match.channels, match.labels, match.unmatched
        (('Actor:M001',), ('M001',), ('elbow',))
    """

    channels: tuple[str, ...]
    labels: tuple[str, ...]
    unmatched: tuple[str, ...]

    def notes(self) -> list[str]:
        """For people to read: what was left out."""
        return [f"left out {listed(self.unmatched)}: not among the attachment's markers"] if self.unmatched else []


def match_labels(found: Sequence[str], known: Sequence[str], renamed: Mapping[str, str] | None = None) -> LabelMatch:
    """Finds a take's labels among an attachment's: as they are, without a subject's prefix, in another case.

    Args:
        found: the take's.
        known: the attachment's.
        renamed: the attachment's label by the take's, with its subject or without, which goes first; an empty one
            leaves the marker out, and ``Actor:*`` with an empty one a whole subject.

    Raises:
        NameMismatchError: two labels mean one marker, none means any, or ``renamed`` names a label that is not there.

    Example:
        >>> match_labels(["Actor:M001", "m002", "*12"], ["M001", "M002"]).labels
        ('M001', 'M002')
    """
    renamed = _spelled_out(renamed or {}, found)
    for side, names, there in (("the take", renamed, found), ("the attachment", renamed.values(), known)):
        absent = [name for name in names if name and name not in there]
        if absent:
            raise NameMismatchError(
                f"labels: found {listed(absent)} in the map, expected labels of {side}: {listed(there)}"
            )
    assigned: dict[str, str] = {}  # channel by known label
    for channel, own in renamed.items():
        if own:
            _assign(assigned, own, channel)
    for fold in (False, True):
        folded = {_spelled(label, fold): label for label in known}
        bare = {_spelled(_bare(label), fold): label for label in known}
        for strip in (False, True):
            here: dict[str, str] = {}
            for channel in found:
                if channel in renamed or channel in assigned.values():
                    continue
                label = _known_as(channel, folded, bare, fold, strip)
                if label is None or label in assigned:
                    continue
                _assign(here, label, channel)
            assigned |= here
    by_channel = {channel: label for label, channel in assigned.items()}
    channels = tuple(channel for channel in found if channel in by_channel)
    if not channels:
        raise NameMismatchError(
            f"labels: found {listed(found)}, expected some of the attachment's: {listed(known)}; a table with a row "
            "'label of the take,label of the attachment' for each marker maps them (--labels map.csv)"
        )
    return LabelMatch(
        channels,
        tuple(by_channel[channel] for channel in channels),
        tuple(channel for channel in found if channel not in by_channel),
    )


def own_labels(found: Sequence[str], renamed: Mapping[str, str] | None = None) -> LabelMatch:
    """A take's labels where no attachment says what they should be: all but the unlabelled, without a common prefix.

    Args:
        found: the take's.
        renamed: what to call a label; an empty one leaves the marker out, ``Actor:*`` a whole subject.

    Raises:
        NameMismatchError: two labels become one, none is left, or ``renamed`` names a label that is not there.

    Example:
        >>> own_labels(["Actor:M001", "Actor:M002", "*12"]).labels
        ('M001', 'M002')
    """
    renamed = _spelled_out(renamed or {}, found)
    absent = [name for name in renamed if name not in found]
    if absent:
        raise NameMismatchError(
            f"labels: found {listed(absent)} in the map, expected labels of the take: {listed(found)}"
        )
    channels = [name for name in found if renamed.get(name, name) and not _UNLABELLED.fullmatch(_bare(name).strip())]
    if not channels:
        raise NameMismatchError(f"labels: found {listed(found)}, expected labelled markers")
    bare = [renamed.get(name, _bare(name)) for name in channels]
    labels = bare if len(set(bare)) == len(bare) else [renamed.get(name, name) for name in channels]
    assigned: dict[str, str] = {}
    for channel, label in zip(channels, labels, strict=True):
        _assign(assigned, label, channel)
    return LabelMatch(tuple(channels), tuple(labels), tuple(name for name in found if name not in channels))


def sided_pairs(labels: Sequence[str]) -> list[tuple[int, int]]:
    """Rows of labels that say left and right of one place: ``LBRO`` and ``RBRO``, ``brow_l`` and ``brow_r``.

    Example:
        >>> sided_pairs(["LBRO", "RBRO", "Lip", "cheekLeft", "cheekRight"])
        [(0, 1), (3, 4)]
    """
    row = {label: i for i, label in enumerate(labels)}
    pairs = []
    for i, label in enumerate(labels):
        for side in _LEFT.finditer(label):
            other = row.get(f"{label[: side.start()]}{_RIGHT[side[0]]}{label[side.end() :]}")
            if other is not None:
                pairs.append((i, other))
                break
    return pairs


def _spelled_out(renamed: Mapping[str, str], found: Sequence[str]) -> dict[str, str]:
    """A map with ``Actor:*`` as the labels of that subject, which it leaves out, and labels with their subject where
    it names none."""
    count = Counter(map(_bare, found))
    whole = {_bare(name): name for name in found if count[_bare(name)] == 1}
    subjects = [name for name, label in renamed.items() if not label and name.endswith(":*")]
    plain = {
        name if name in found else whole.get(name, name): renamed[name] for name in renamed if name not in subjects
    }
    for pattern in subjects:
        plain |= {name: "" for name in found if name.startswith(pattern[:-1]) and name not in plain}
    return plain


def _known_as(channel: str, known: Mapping[str, str], bare: Mapping[str, str], fold: bool, strip: bool) -> str | None:
    """The known label of a channel, its whole name or what follows a separator in it."""
    if not strip:
        return known.get(_spelled(channel, fold))
    for begin in (0, *(separator.end() for separator in re.finditer(r"[:|/._-]", channel))):  # the longest first
        rest = channel[begin:]
        label = known.get(_spelled(rest, fold)) or bare.get(_spelled(rest, fold))
        if label is not None:
            return label
    return None


def _bare(name: str) -> str:
    return name.rpartition(":")[2]


def _spelled(name: str, fold: bool) -> str:
    return name.strip().casefold() if fold else name.strip()


def _assign(assigned: dict[str, str], label: str, channel: str) -> None:
    if label in assigned:
        raise NameMismatchError(
            f"labels: found {assigned[label]!r} and {channel!r} for the marker {label!r}, expected one: leave the "
            "other out by a row without a second cell in a table (--labels map.csv; 'Actor:*,' for a whole subject)"
        )
    assigned[label] = channel
