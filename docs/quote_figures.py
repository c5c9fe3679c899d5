"""Puts the figures that the benchmarks kept into the README: ``python docs/quote_figures.py`` after ``make bench``.

A figure stands between ``<!-- BENCH FIGURE -->`` and ``<!-- / -->``, named as in ``docs/figures.json``.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

DOCS = Path(__file__).resolve().parent
README = DOCS.parent / "README.md"
_QUOTED = re.compile(r"(<!-- (\w+) (\w+) -->).*?(<!-- / -->)")


def quoted(text: str, figures: dict[str, dict[str, str]]) -> str:
    """The text with every figure as it was kept last; raises ``KeyError`` for one that no benchmark kept."""
    return _QUOTED.sub(lambda found: f"{found[1]}{figures[found[2]][found[3]]}{found[4]}", text)


if __name__ == "__main__":
    README.write_text(quoted(README.read_text(), json.loads((DOCS / "figures.json").read_text())))
