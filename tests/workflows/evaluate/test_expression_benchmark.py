"""Folders of films' weights are compared with the truth, a row a method; what is missing counts as no motion."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.cli import main
from torchface.errors import ShapeError, ValueRangeError
from torchface.io.weights.live_link_csv import save_live_link
from torchface.shape_names import ARKIT
from torchface.take import Take, Track
from torchface.workflows.evaluate.expression_benchmark import NOTHING, expression_benchmark

JAW = ARKIT.index("jawOpen")


def save(weights: Tensor, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    save_live_link(Take(30.0, weights=Track(ARKIT, weights[..., None])), path)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Two films; one method halves weights and knows no tongue, another has one of the films alone."""
    films, results = tmp_path / "films", tmp_path / "results"
    for number, film in enumerate(("a", "b")):
        true = torch.zeros(60, len(ARKIT))
        true[:, JAW] = torch.linspace(0, 6 + number, 60).sin().square()
        save(true, films / f"{film}.csv")
        halved = 0.5 * true
        halved[:, ARKIT.index("tongueOut")] = torch.nan
        save(halved, results / "half" / f"{film}.csv")
        if film == "a":
            save(true, results / "perfect" / film / "live_link.csv")
            save(true, results / ".ipynb_checkpoints" / "a.csv")  # neither a method nor a film
            (films / "._a.csv").write_bytes(b"\0\5\x16\7")
    return results, films


def test_methods_are_compared(folders: tuple[Path, Path], tmp_path: Path) -> None:
    found = expression_benchmark(*folders, tmp_path / "out")
    assert list(found.methods) == ["half", "perfect", NOTHING]
    half, perfect, nothing = found.methods.values()
    assert half.error() == pytest.approx(0.5 * nothing.error(), rel=1e-5)
    assert half.shape_mean("slope")[JAW] == pytest.approx(0.5)
    assert half.unsupported == ("tongueOut",)
    assert found.missing == {"half": (), "perfect": ("b",), NOTHING: ()}
    assert perfect.films["a"].region_error() == 0
    assert perfect.films["b"].region_error() == nothing.films["b"].region_error()
    assert any("no result for b" in line for line in found.lines())
    page = (tmp_path / "out" / "index.html").read_text()
    assert "half" in page
    rows = (tmp_path / "out" / "shapes.csv").read_text().splitlines()
    assert [row.split(",")[:2] for row in rows[1:]] == [["jawOpen", name] for name in ("half", "perfect", NOTHING)]


def test_the_command(folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results, films = folders
    main(["evaluate", str(results / "half"), str(films), "--benchmark", "--out", str(tmp_path / "out"), "--quiet"])
    assert "not given: tongueOut" in capsys.readouterr().err
    assert (tmp_path / "out" / "methods.csv").read_text().startswith("method,error")


def test_mistakes_are_said(folders: tuple[Path, Path], tmp_path: Path) -> None:
    results, films = folders
    with pytest.raises(ValueRangeError, match=r"found no \.csv, expected the true weights"):
        expression_benchmark(results, tmp_path, tmp_path / "out")
    with pytest.raises(ValueRangeError, match="found no result of a, b"):
        expression_benchmark(results / "perfect" / "a", films, tmp_path / "out")
    save(torch.zeros(10, len(ARKIT)), results / "half" / "a.csv")
    with pytest.raises(ShapeError, match="a: found 10 frames of weights, expected the film's 60"):
        expression_benchmark(results, films, tmp_path / "out")
    assert not (tmp_path / "out" / "index.html").exists()
