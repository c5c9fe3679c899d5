"""Expressions of rendered people against the truth: ``live``, ``track``, MediaPipe's blendshapes, and nothing moving.

Four films of two seconds; with ``TORCHFACE_FILMS=all`` the twelve of ``train.expression_films``, which take about ten
minutes to render and are kept in ``out/expression_films``. ``TORCHFACE_METHODS=live,mediapipe`` runs some methods.
"""

import os
from pathlib import Path

import pytest
import torch
from coded_frames import ATTRIBUTES, agreement, coded
from expression_methods import Clip, examples, live, mean_head, mediapipe, own_head, run_methods, track

from torchface.shape_names import ARKIT
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
        "track no rig": track(None),
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
    for name in ("live", "track", "track no rig", "track, own rig"):
        if name in benchmark.methods:
            assert benchmark.methods[name].error() < nothing


def test_real_frames(data: Path) -> None:
    """Frames that were coded by eye: eyes shut, lips apart, smile, brows up, by all methods through the same limits."""
    pytest.importorskip("ai_edge_litert")
    methods = {"mediapipe": mediapipe(data / "peers" / "face_landmarker.task"), "live": live, "track": track(mean_head)}
    films = {
        name: Clip(next(path for path in sorted((data / "video").rglob("*")) if path.stem == name)) for name in coded()
    }
    print("\nyes found of all, no found of all")
    print(f"{'':16s}" + "".join(f"{words:>18s}" for words, _, _ in ATTRIBUTES.values()))
    for name, method in methods.items():
        counts = agreement({film: method(clip)[0] for film, clip in films.items()})
        print(f"{name:16s}" + "".join(f"{f'{a}/{b}, {c}/{d}':>18s}" for a, b, c, d in counts.values()))
        assert set(counts) == set(ATTRIBUTES)


def test_coding_is_counted() -> None:
    """Weights that are made of the coding agree with it everywhere; those at rest agree where the answer is no."""
    made = {}
    for film, parts in coded().items():
        weights = made[film] = torch.zeros(120, len(ARKIT))
        for name, rows in (("shut", ("eyeBlink",)), ("apart", ("mouthLowerDown", "mouthUpperUp", "jawOpen")),
                           ("smile", ("mouthSmile",)), ("brows_up", ("browInnerUp", "browOuterUp"))):  # fmt: skip
            columns = [row for row, shape in enumerate(ARKIT) if shape.startswith(rows)]
            for frame, yes in parts.get(name, {}).items():
                weights[frame, columns] = float(yes)
    for a, b, c, d in agreement(made).values():
        assert (a, c) == (b, d)
        assert b > 2
        assert d > 5
    still = agreement({film: torch.zeros(120, len(ARKIT)) for film in made})
    assert all((a, c) == (0, d) for a, _, c, d in still.values())
