"""A report as one HTML page with images beside it; opens in any browser, from disk, without a network."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from torchface.escaped_text import as_markup
from torchface.files.whole_files import all_or_none, make_folder, write_file
from torchface.rendering.compositing import save_rendered_image

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 1240px; padding: 0 1rem; color: #222 }
h1 { font-size: 1.6rem } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #ddd }
img { max-width: 100%; height: auto; display: block; margin: .6rem 0 }
table { border-collapse: collapse; margin: .6rem 0 } th, td { padding: .15rem .8rem .15rem 0; text-align: left }
td + td { font-variant-numeric: tabular-nums; text-align: right } th + th { text-align: right }
summary { cursor: pointer; color: #1f5fa8 }
thead { border-bottom: 1px solid #999 } tbody tr:nth-child(even) { background: #f6f6f6 }
p, ul { max-width: 60rem } td + td.long { text-align: left; max-width: 60rem }
"""
# Characters beyond which a cell is text, not a figure.
_LONG = 60


@dataclass(frozen=True)
class Table:
    """Rows of cells under a heading row; with a ``summary`` that alone shows until it is opened."""

    heading: Sequence[str]
    rows: Sequence[Sequence[str]]
    summary: str = ""


@dataclass(frozen=True, eq=False)
class Section:
    """A heading, a paragraph or, where the text has several lines, a list of them, ready-made HTML, then tables and
    figures (3,H,W) by file name, in this order."""

    title: str
    text: str = ""
    tables: Sequence[Table] = ()
    figures: Sequence[tuple[str, Tensor]] = ()
    markup: str = ""


def write_page(folder: str | Path, title: str, sections: Sequence[Section]) -> Path:
    """Writes ``index.html`` and its figures into a folder; they take their places together; the page's path."""
    folder = make_folder(folder)
    with all_or_none():
        return _write(folder, title, sections)


def _write(folder: Path, title: str, sections: Sequence[Section]) -> Path:
    parts = [
        f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{as_markup(title)}</title>\n'
        f"<style>{_STYLE}</style>\n<h1>{as_markup(title)}</h1>\n"
    ]
    for section in sections:
        parts.append(f"<h2>{as_markup(section.title)}</h2>\n")
        if section.text:
            parts.append(_text(section.text))
        parts.append(section.markup)
        parts.extend(_table(table) for table in section.tables)
        for name, figure in section.figures:
            save_rendered_image(figure, folder / name)
            size = f'width="{figure.shape[2]}" height="{figure.shape[1]}"'
            parts.append(f'<img src="{as_markup(name)}" alt="{as_markup(section.title)}" {size}>\n')
    page = folder / "index.html"
    write_file(page, "".join(parts).encode())
    return page


def _text(text: str) -> str:
    lines = text.split("\n")
    if len(lines) == 1:
        return f"<p>{as_markup(text)}</p>\n"
    return "<ul>\n" + "".join(f"<li>{as_markup(line)}</li>\n" for line in lines) + "</ul>\n"


def _table(table: Table) -> str:
    def row(cells: Sequence[str], tag: str) -> str:
        tags = [f'{tag} class="long"' if len(cell) > _LONG else tag for cell in cells]
        return (
            "<tr>" + "".join(f"<{a}>{as_markup(cell)}</{tag}>" for a, cell in zip(tags, cells, strict=True)) + "</tr>"
        )

    body = "\n".join(row(cells, "td") for cells in table.rows)
    text = f"<table>\n<thead>{row(table.heading, 'th')}</thead>\n<tbody>\n{body}\n</tbody>\n</table>\n"
    return f"<details><summary>{as_markup(table.summary)}</summary>\n{text}</details>\n" if table.summary else text
