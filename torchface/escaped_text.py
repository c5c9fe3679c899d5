"""Names and texts from files as people may see them: long lists cut short, harmful characters spelled out."""

import html
import re
from collections.abc import Iterable

# C0 but for tab and line feed, DEL, C1, marks that change a line's direction, line separators, halves of surrogates.
_HARMFUL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def visible(text: str) -> str:
    r"""The text with control characters spelled as Python does.

    Example:
        >>> visible("smile\x1b[2Jleft")
        'smile\\x1b[2Jleft'
    """
    return _HARMFUL.sub(lambda match: match[0].encode("unicode_escape").decode("ascii"), text)


def as_markup(text: str) -> str:
    """The visible text for a page: as it is, not as markup."""
    return html.escape(visible(text))


def listed(names: Iterable[str], limit: int = 8) -> str:
    """The first names, and how many more there are.

    Example:
        >>> listed("abcd", limit=2)
        'a, b and 2 more'
    """
    names = list(names)
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")
