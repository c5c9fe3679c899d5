"""Expressions of rendered people against the truth: ``live``, ``track``, MediaPipe's blendshapes, and nothing moving.

Four films of two seconds; with ``TORCHFACE_FILMS=all`` the twelve of ``train.expression_films``, which take about ten
minutes to render and are kept in ``out/expression_films``. ``TORCHFACE_METHODS=live,mediapipe`` runs some methods.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch
from expression_methods import examples, live, mean_head, mediapipe, own_head, run_methods, track

from torchface.workflows.evaluate.expression_benchmark import NOTHING, ExpressionBenchmark, expression_benchmark
from train.expression_films import Settings, render

pytestmark = [pytest.mark.real, pytest.mark.bench]

ALL = os.environ.get("TORCHFACE_FILMS") == "all"
OUT = Path("out/expression_films") / ("all" if ALL else "small")


@pytest.fixture(scope="module")
def benchmark(data: Path, tmp_path_factory: pytest.TempPathFactory) -> ExpressionBenchmark:
    torch.set_num_threads(1)
    pytest.importorskip("ai_edge_litert")
    ict, results = data / "ict_facekit" / "FaceXModel", tmp_path_factory.mktemp("results")
    films = render(Settings(out=OUT, takes=data / "performances", ict=ict, small=not ALL))
    seen = mediapipe(data / "peers" / "face_landmarker.task")
    methods = {
        "mediapipe": seen,
        "live": live,
        "track": track(mean_head),
        "track, own rig": track(own_head(ict)),
        "dissertation": examples(lambda film: seen(film)[1]),
    }
    wanted = os.environ.get("TORCHFACE_METHODS", ",".join(methods)).split(",")
    run_methods({name: method for name, method in methods.items() if name in wanted}, films, results)
    return expression_benchmark(results, OUT, OUT / "report")


def test_expressions(benchmark: ExpressionBenchmark) -> None:
    """The table; what is ours is nearer to the truth than nothing that moves."""
    table = benchmark.table()
    print()
    for row in (table.heading, *table.rows):
        print(f"{row[0]:16s}" + "".join(f"{cell:>9s}" for cell in row[1:]))
    for line in benchmark.lines():
        print(line)
    nothing = benchmark.methods[NOTHING].error()
    for name in ("live", "track", "track, own rig"):
        if name in benchmark.methods:
            assert benchmark.methods[name].error() < nothing
