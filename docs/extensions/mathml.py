"""Formulas as MathML, which browsers draw by themselves: the pages hold no script and need no network."""

from __future__ import annotations

import re
from html import escape
from typing import Any
from xml.etree import ElementTree

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

# What the converter does not know, in words that it knows.
_SPELLINGS = (
    (re.compile(r"\{(aligned|gathered)\}"), "{split}"),
    (re.compile(r"\\arg\s*\\(min|max)"), r"\\operatorname{arg\1}"),
    (re.compile(r"(\\[Bb]igg?)[lr]?\s*\\[lr]Vert"), r"\1‖"),
    (re.compile(r"(\\[Bb]igg?)[lr]?\s*\\[lr]vert"), r"\1|"),
    (re.compile(r"\\[Bb]igg?l?\s*([(\[])"), r"\\left\1"),
    (re.compile(r"\\[Bb]igg?r?\s*([)\]])"), r"\\right\1"),
)
_WITHOUT_ROOM = ("log", "ln", "diag")
_WITH_LIMITS = {"min": "min", "max": "max", "argmin": "arg\u2009min", "argmax": "arg\u2009max"}


def mathml(latex: str, display: str) -> str:
    """LaTeX as a ``<math>`` element; ``display`` is ``"inline"`` or ``"block"``."""
    spelled = latex
    for pattern, spelling in _SPELLINGS:
        spelled = pattern.sub(spelling, spelled)
    try:
        tree = ElementTree.fromstring(convert(spelled, xmlns="", display=display))
    except Exception as error:
        raise ExtensionError(f"a formula that cannot be drawn: {latex!r}") from error
    texts = [element.text for element in tree.iter() if element.text]
    if any(text.startswith("\\") for text in texts):
        raise ExtensionError(f"a formula with a command that the converter does not know: {latex!r}")
    for element in tree.iter():
        _set_below(element)
        _keep_bars_short(element)
        if element.text in _WITHOUT_ROOM:
            element.tag, element.attrib = "mo", {"lspace": "0.17em", "rspace": "0.17em"}
    return ElementTree.tostring(tree, encoding="unicode")


def _set_below(element: ElementTree.Element) -> None:
    """What a least value is taken over stands below the word, not behind it."""
    if element.tag == "mo" and element.text in _WITH_LIMITS:
        element.text = _WITH_LIMITS[element.text]
        element.set("movablelimits", "true")
    if element.tag == "msub" and element[0].tag == "mo" and element[0].text in _WITH_LIMITS:
        element.tag = "munder"


def _keep_bars_short(element: ElementTree.Element) -> None:
    """A bar that opens looks like one that closes: browsers would stretch the wrong one over the rest of the line."""
    if element.tag == "mo" and element.text in ("\u2016", "|"):
        element.attrib = {"stretchy": "false", "lspace": "0.05em", "rspace": "0.05em"}


def aligned(latex: str) -> str:
    """Rows set apart by ``\\\\`` and aligned at ``&``, as Sphinx allows without an environment of their own."""
    return rf"\begin{{split}}{latex}\end{{split}}" if r"\\" in latex and r"\begin" not in latex else latex


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
