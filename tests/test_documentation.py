"""Links, figures, versions and checks that README, CONTRIBUTING and docs/ name are there and agree."""

import importlib
import importlib.util
import json
import re
from pathlib import Path
from types import ModuleType

import pytest

import torchface

REPOSITORY = Path(__file__).resolve().parent.parent
DOCS = REPOSITORY / "docs"
PAGES = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
_LINK = re.compile(r"\]\(([^)#\s]+)[^)]*\)")
_ANCHOR = re.compile(r"\]\(([\w./-]*\.md)?#([\w-]+)\)")
_HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
_BENCH = re.compile(r"\b(test_\w+\.py)\b")


@pytest.fixture(scope="module")
def quote_figures() -> ModuleType:
    spec = importlib.util.spec_from_file_location("quote_figures", DOCS / "quote_figures.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_lead_to_files(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    lost = [link for link in _LINK.findall(text) if "://" not in link and not (page.parent / link).exists()]
    assert not lost


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_lead_to_headings(page: Path) -> None:
    lost = []
    for file, anchor in _ANCHOR.findall(page.read_text(encoding="utf-8")):
        target = page.parent / file if file else page
        if not target.exists():  # the test above names it
            continue
        headings = _HEADING.findall(re.sub(r"```.*?```", "", target.read_text(encoding="utf-8"), flags=re.DOTALL))
        if anchor not in {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}:
            lost.append(f"{file}#{anchor}")
    assert not lost


def test_benchmarks_that_pages_name_are_there() -> None:
    named = {name for page in PAGES for name in _BENCH.findall(page.read_text())}
    lost = [name for name in named if not any((REPOSITORY / "tests").rglob(name))]
    assert not lost


def test_limits_that_a_page_names_are_the_code_s() -> None:
    page = (DOCS / "concepts" / "what_torchface_notices.md").read_text()
    named = re.findall(r"(-?[\d._]+) \(`(\w+)\.(\w+)`\)", page)
    assert len(named) > 90
    for value, file, name in named:
        (path,) = (REPOSITORY / "torchface").rglob(f"{file}.py")
        module = importlib.import_module(".".join(path.relative_to(REPOSITORY).with_suffix("").parts))
        assert getattr(module, name) == float(value), f"{file}: {name}"


def test_readme_quotes_the_figures_that_were_kept(quote_figures: ModuleType) -> None:
    readme = (REPOSITORY / "README.md").read_text()
    assert quote_figures.quoted(readme, json.loads((DOCS / "figures.json").read_text())) == readme


def test_a_figure_is_quoted_between_its_marks(quote_figures: ModuleType) -> None:
    text = "takes <!-- bench time -->9 s<!-- / --> and <!-- bench size -->1 MB<!-- / -->"
    filled = quote_figures.quoted(text, {"bench": {"time": "2 s", "size": "3 MB"}})
    assert filled == "takes <!-- bench time -->2 s<!-- / --> and <!-- bench size -->3 MB<!-- / -->"
    with pytest.raises(KeyError):
        quote_figures.quoted(text, {"bench": {"time": "2 s"}})


def test_every_page_names_the_same_version() -> None:
    version = torchface.__version__
    assert f"\nversion: {version}\n" in (REPOSITORY / "CITATION.cff").read_text(encoding="utf-8")
    assert f"torchface-{version}-py3-none-any.whl" in (DOCS / "install.md").read_text(encoding="utf-8")
    releases = re.findall(r"^## \[(.+?)\]", (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert next(each for each in releases if each != "Unreleased") == version


def test_pre_commit_runs_the_checks_of_make_lint() -> None:
    (checks,) = re.findall(r"^lint: (.+)$", (REPOSITORY / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    hooks = (REPOSITORY / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    assert re.findall(r"^ +entry: make (\w+)$", hooks, re.MULTILINE) == checks.split()
