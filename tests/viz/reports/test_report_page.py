"""A report page shows what it was given, escaped, with every picture beside it."""

import re
from pathlib import Path

import torch
from PIL import Image

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
