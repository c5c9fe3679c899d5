"""Comparison of many films' weights with their true ones, a table a method: ``torchface evaluate --benchmark``."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.evaluation.expression_scores import MethodScore, expression_score
from torchface.files.job_lock import within_job
from torchface.files.whole_files import all_or_none, visible_files
from torchface.io import load_take
from torchface.io.tables.csv_table import write_table
from torchface.progress import Progress, silent
from torchface.shape_names import ARKIT, mapping
from torchface.take import Track
from torchface.viz.figures.curves import named_bars
from torchface.viz.reports.report_page import Section, Table, write_page

NOTHING = "nothing moves"  # the method beside all others: every weight is 0

FIGURES: dict[str, Callable[[MethodScore], str]] = {
    "error": lambda method: f"{method.error():.3f}",
    "eyes": lambda method: f"{method.error('eyes'):.3f}",
    "brows": lambda method: f"{method.error('brows'):.3f}",
    "mouth": lambda method: f"{method.error('mouth'):.3f}",
    "gaze": lambda method: f"{method.error('gaze'):.3f}",
    "r": lambda method: f"{method.typical('correlation'):.2f}",
    "r brows": lambda method: f"{method.typical('correlation', 'brows'):.2f}",
    "r gaze": lambda method: f"{method.typical('correlation', 'gaze'):.2f}",
    "slope": lambda method: f"{method.typical('slope'):.2f}",
    "lag ms": lambda method: f"{method.lag:.0f}",
    "jitter": lambda method: f"{method.jitter:.4f}",
    "blinks": lambda method: f"{method.blinks.found}/{method.blinks.true}",
    "false": lambda method: f"{method.blinks.false}",
    "both on": lambda method: f"{method.both:.1%}",
    "restless": lambda method: f"{len(method.restless)}",
    "unsupported": lambda method: f"{len(method.unsupported)}",
}
"""Columns of the table, and a method's figures in them."""

_TEXT = (
    "Root mean square errors of weights that the truth moves by more than 0.05: of all shapes but the eyes' ones, "
    "of regions, of the eyes' directions; r and slope: medians over shapes of correlation with the truth and of "
    "slope on it, 0 for shapes that are not given; milliseconds by which weights come late; their jitter where "
    "the truth rests; true blinks found, and false ones; share of frames with antagonists both above 0.1; how many "
    "shapes never rest, and how many are not given."
)


@dataclass(frozen=True, eq=False)
class ExpressionBenchmark:
    """Scores of methods over films."""

    films: tuple[str, ...]
    frames: int  # how many they have together
    methods: dict[str, MethodScore]  # scores by the methods' names; the last is NOTHING
    missing: dict[str, tuple[str, ...]]  # films without a result, by method, which counts as nothing that moves

    def table(self) -> Table:
        """A row a method."""
        rows = [(name, *(figure(score) for figure in FIGURES.values())) for name, score in self.methods.items()]
        return Table(("method", *FIGURES), rows)

    def lines(self) -> list[str]:
        """For people to read."""
        lines = [f"{len(self.films)} films, {self.frames} frames"]
        for name, score in self.methods.items():
            if name == NOTHING:
                continue
            if score.restless:
                lines.append(f"{name}: never at rest: {', '.join(score.restless)}")
            if score.unsupported:
                lines.append(f"{name}: not given: {', '.join(score.unsupported)}")
            if self.missing[name]:
                lines.append(f"{name}: no result for {', '.join(self.missing[name])}; counted as nothing that moves")
        return lines


def expression_benchmark(
    results: Path, films: Path, out: Path, progress: Progress | None = None
) -> ExpressionBenchmark:
    """Compares weights of films with the truth, ``FILM.csv`` in a folder, and writes figures and a report.

    Results are a folder with ``FILM.csv`` or ``FILM/live_link.csv`` of each film, or a folder of such folders, one a
    method. An empty column says that the method does not give the shape.
    """
    progress = progress or silent
    with within_job(out):
        truths = {path.stem: _arkit(path) for path in visible_files(films, (".csv",))}
        if not truths:
            raise ValueRangeError(f"{films}: found no .csv, expected the true weights of films")
        folders = {results.name: results} if _results(results, truths) else {
            path.name: path for path in visible_files(results) if path.is_dir() and _results(path, truths)
        }  # fmt: skip
        if not folders:
            raise ValueRangeError(
                f"{results}: found no result of {', '.join(truths)}, expected FILM.csv of some of them"
            )
        methods: dict[str, MethodScore] = {}
        missing: dict[str, tuple[str, ...]] = {}
        for number, (name, folder) in enumerate(folders.items()):
            progress("comparing", number, len(folders))
            there = _results(folder, truths)
            given = {film: _weights(path) for film, path in there.items()}
            methods[name] = scored(given, truths)
            missing[name] = tuple(film for film in truths if film not in there)
        methods[NOTHING], missing[NOTHING] = scored({}, truths), ()
        frames = sum(len(true) for true, _ in truths.values())
        benchmark = ExpressionBenchmark(tuple(truths), frames, methods, missing)
        with all_or_none():
            _write(benchmark, out)
    return benchmark


def scored(given: dict[str, tuple[Tensor, tuple[str, ...]]], truths: dict[str, tuple[Tensor, float]]) -> MethodScore:
    """Scores of a method's weights (T,N), with their names, of films with true ones (T,52) and a rate."""
    scores = {}
    for film, (true, fps) in truths.items():
        weights, names = given.get(film, (torch.zeros_like(true), ARKIT))
        if len(weights) != len(true):
            raise ShapeError(f"{film}: found {len(weights)} frames of weights, expected the film's {len(true)}")
        scores[film] = expression_score(weights, names, true, fps)
    return MethodScore(scores)


def _results(folder: Path, truths: dict[str, tuple[Tensor, float]]) -> dict[str, Path]:
    """Files of weights in a folder by film."""
    places = {film: (folder / f"{film}.csv", folder / film / "live_link.csv") for film in truths}
    found = {film: next((path for path in paths if path.is_file()), None) for film, paths in places.items()}
    return {film: path for film, path in found.items() if path is not None}


def _weights(path: Path) -> tuple[Tensor, tuple[str, ...]]:
    take = load_take(path)
    if take.weights is None:
        raise ValueRangeError(f"{path}: found no weights, expected some")
    return take.weights.values[..., 0].float(), take.weights.names


def _arkit(path: Path) -> tuple[Tensor, float]:
    """True weights (T,52), and frames a second."""
    take = load_take(path)
    weights = take.weights or Track((), torch.zeros(len(take), 0, 1))
    return (weights.values[..., 0] @ mapping(weights.names, ARKIT).to(weights.values).T).float(), take.fps


def _write(benchmark: ExpressionBenchmark, out: Path) -> Path:
    table = benchmark.table()
    write_table(out / "methods.csv", list(table.heading), [list(row) for row in table.rows])
    parts = ("correlation", "slope", "error")
    means = {name: [score.shape_mean(part) for part in parts] for name, score in benchmark.methods.items()}
    moved = [row for row in range(len(ARKIT)) if math.isfinite(float(means[NOTHING][2][row]))]
    cells = [
        [ARKIT[row], name, *(f"{float(part[row]):.4f}" for part in values)]
        for row in moved
        for name, values in means.items()
    ]
    write_table(out / "shapes.csv", ["shape", "method", *parts], cells)
    names = [ARKIT[row] for row in moved]
    shapes = [
        (name, *(f"{float(means[method][0][row]):.2f}, {float(means[method][2][row]):.3f}" for method in means))
        for name, row in zip(names, moved, strict=True)
    ]
    films = [
        (film, *(f"{score.films[film].region_error():.3f}" for score in benchmark.methods.values()))
        for film in benchmark.films
    ]
    figures = [
        (f"shapes_{number}.png", named_bars(values[2][moved], names, f"{method}: error of the weight"))
        for number, (method, values) in enumerate(means.items())
        if method != NOTHING
    ]
    heading = tuple(benchmark.methods)
    sections = [
        Section("Methods", _TEXT, [table]),
        Section("What is said of them", "; ".join(benchmark.lines())),
        Section("By film", "Error of all shapes but the eyes' directions.", [Table(("film", *heading), films)]),
        Section("By shape", "Correlation, error.", [Table(("shape", *heading), shapes)], figures),
    ]
    return write_page(out, "Expressions against the truth", sections)
