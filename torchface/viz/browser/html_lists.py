"""Lists of a page's panel as HTML; names from files are escaped."""

from collections.abc import Sequence

from torchface.escaped_text import as_markup

_MAX_SHAPES = 8


def shape_list(active: Sequence[tuple[str, float]]) -> str:
    """Shapes and weights as bars, the first eight, always of one height; says so where there is none."""
    rows = [
        '<div style="display:flex;align-items:center;gap:0.5em;line-height:1.35">'
        f'<span style="flex:0 0 48%;overflow:hidden;text-overflow:ellipsis;white-space:nowrap">{as_markup(name)}</span>'
        '<span style="flex:1;height:0.5em;background:rgba(128,128,128,0.18);border-radius:2px">'
        f'<span style="display:block;height:100%;border-radius:2px;background:#2e5c8a;'
        f'width:{100 * min(abs(weight), 1.0):.0f}%"></span></span>'
        f'<span style="flex:0 0 3em;text-align:right">{weight:.2f}</span></div>'
        for name, weight in active[:_MAX_SHAPES]
    ]
    more = f"and {len(active) - _MAX_SHAPES} more" if len(active) > _MAX_SHAPES else ""
    rest = more if active else "No shape is active."
    # Without a fixed height the sliders below would jump while a take plays.
    height = f"height:{1.35 * (_MAX_SHAPES + 1):.2f}em"
    return f'<div style="padding:0.2em 0.75em;font-size:0.8em;{height}">{"".join(rows)}{_grey(rest)}</div>'


def pick_list(counts: Sequence[tuple[str, str]], last: Sequence[str]) -> str:
    """How many of each kind are picked, and the last ones by name."""
    rows = [
        f'<div style="display:flex;line-height:1.5"><span style="flex:1">{as_markup(kind)}</span>'
        f"<b>{as_markup(count)}</b></div>"
        for kind, count in counts
    ]
    names = "".join(f'<div style="line-height:1.4">{_grey(name)}</div>' for name in last)
    return f'<div style="padding:0.2em 0.75em;font-size:0.85em">{"".join(rows)}{names}</div>'


def caption(text: str) -> str:
    """A small grey line."""
    return f'<div style="padding:0 0.75em 0.3em;font-size:0.8em">{_grey(text)}</div>'


def _grey(text: str) -> str:
    return f'<span style="opacity:0.65">{as_markup(text)}</span>'
