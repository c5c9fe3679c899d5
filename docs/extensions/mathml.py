"""Formulas as MathML, which browsers draw by themselves: the pages hold no script and need no network."""

from __future__ import annotations

from html import escape
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError


def mathml(latex: str, display: str) -> str:
    """LaTeX as a ``<math>`` element; ``display`` is ``"inline"`` or ``"block"``."""
    try:
        return convert(latex, display=display)
    except Exception as error:
        raise ExtensionError(f"a formula that cannot be drawn: {latex!r}") from error


def aligned(latex: str) -> str:
    """Rows set apart by ``\\\\`` and aligned at ``&``, as Sphinx allows without an environment of their own."""
    return rf"\begin{{aligned}}{latex}\end{{aligned}}" if r"\\" in latex and r"\begin" not in latex else latex


def visit_inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def visit_block(translator: Any, node: nodes.math_block) -> None:
    number = f'<span class="eqno">({escape(node["number"])})</span>' if node.get("number") else ""
    translator.body.append(translator.starttag(node, "div", CLASS="math"))
    # Paragraphs of a formula are formulas below each other.
    parts = [part for part in node.astext().split("\n\n") if part.strip()]
    translator.body.extend(mathml(aligned(part), "block") for part in parts)
    translator.body.append(f"{number}</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Registers the renderer under the name ``mathml``."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
