"""A report page shows what it was given, escaped, with every picture beside it."""

import re
from html.parser import HTMLParser
from pathlib import Path

import torch
from PIL import Image

from torchface.viz.browser import html_lists
from torchface.viz.reports.report_page import Section, Table, write_page


def test_page_holds_tables_and_pictures_and_nothing_half_written(tmp_path: Path) -> None:
    picture = torch.rand(3, 20, 30, generator=torch.Generator().manual_seed(0))
    section = Section("A <b> & c", "text", [Table(("name", "value"), [("x<y", "1")])], [("one.png", picture)])
    page = write_page(tmp_path / "report", "Title & more", [section])
    text = page.read_text()
    assert "A &lt;b&gt; &amp; c" in text
    assert "x&lt;y" in text
    sources = re.findall(r'src="([^"]+)"', text)
    assert sources == ["one.png"]
    with Image.open(page.parent / "one.png") as image:
        assert image.size == (30, 20)
        assert abs(image.getpixel((3, 5))[0] / 255 - float(picture[0, 5, 3])) < 0.003
    assert sorted(path.name for path in page.parent.iterdir()) == ["index.html", "one.png"]


def test_lines_become_a_list(tmp_path: Path) -> None:
    text = write_page(tmp_path, "Title", [Section("Done", "one & two\nthree")]).read_text()
    assert "<ul>\n<li>one &amp; two</li>\n<li>three</li>\n</ul>" in text


HOSTILE = """</title></style><script>alert(1)</script>"><img src=x onerror='alert(1)'>&lt;script&gt;\u202e\u2028"""


def elements(markup: str) -> list[tuple[str, set[str]]]:
    """What a browser makes of it: each element with the names of its attributes."""
    found: list[tuple[str, set[str]]] = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, given: found.append((tag, {name for name, _ in given}))
    parser.feed(markup)
    parser.close()
    return found


def test_no_name_of_a_file_becomes_an_element(tmp_path: Path) -> None:
    """Pages with hostile names have the elements of the same pages with plain names."""

    def pages(name: str) -> list[str]:
        table = Table((name, "value"), [(name, name)], summary=name)
        figure = ("one.png", torch.zeros(3, 4, 4))
        report = write_page(tmp_path, name, [Section(name, name, [table], [figure])]).read_text()
        lists = (html_lists.shape_list([(name, 0.5)]), html_lists.pick_list([(name, name)], [name]))
        lines = (html_lists.caption(name),)
        return [report, *lists, *lines]

    long = "x" * len(HOSTILE)
    for hostile, plain in zip(pages(HOSTILE), pages(long), strict=True):
        assert elements(hostile) == elements(plain)
        assert "\u202e" not in hostile
