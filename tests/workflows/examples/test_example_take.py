"""Landmarks that examples explain: each method gives the planted weights back, and the files say what each costs."""

import csv
from pathlib import Path

import pytest
import torch

from torchface import Take, Track, load_take
from torchface.capture.anybody import ExampleShapes, paper_examples
from torchface.cli import main
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.io.landmarks.openface_csv import save_landmarks_csv
from torchface.landmarks.images.tracking.video_landmarks import LANDMARK_NAMES
from torchface.synthetic import performer
from torchface.workflows.examples.example_take import averaged_examples, solve_by_examples, track_by_examples


@pytest.fixture(scope="module")
def examples() -> ExampleShapes:
    return paper_examples(performer(texture=False))


def planted(examples: ExampleShapes) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights (9,N) of the first expression that come and go, and the landmarks (9,68,2) of a farther face."""
    weights = torch.zeros(9, len(examples.names), dtype=torch.float64)
    weights[:, 0] = torch.linspace(0, torch.pi, 9).sin() * 0.8
    shown = examples.neutral.double() + torch.einsum("tn,mcn->tmc", weights, examples.basis.double())
    return weights, 0.7 * shown + torch.tensor([40.0, 25.0])


def test_planted_weights_come_back_where_size_and_place_are_solved_for(examples: ExampleShapes) -> None:
    weights, landmarks = planted(examples)
    landmarks[4] = torch.nan
    found, solved, figures = solve_by_examples(examples, landmarks, "all")
    seen = torch.arange(9) != 4
    assert (found - weights)[seen].abs().max() < 0.05
    assert bool(found[4].isnan().all())
    assert figures.pixels < 0.3
    assert (solved - landmarks)[seen].norm(dim=-1).mean() < 0.3
    with pytest.raises(ValueRangeError, match="found no frame with all 68"):
        solve_by_examples(examples, landmarks * torch.nan, "all")


def test_the_mean_of_a_person_and_a_larger_turned_copy_is_the_person(examples: ExampleShapes) -> None:
    turn = torch.tensor([[0.8, -0.6], [0.6, 0.8]])
    other = ExampleShapes(examples.names, 1.5 * examples.neutral @ turn.T + 9, 1.5 * examples.landmarks @ turn.T + 9)
    mean = averaged_examples([examples, other.select(other.names[::-1])])
    torch.testing.assert_close(mean.landmarks, examples.landmarks, rtol=0, atol=1e-2)
    with pytest.raises(NameMismatchError, match="expected the same expressions of all"):
        averaged_examples([examples, examples.select(examples.names[:-1])])


def test_the_command_writes_weights_and_a_row_for_each_method(
    examples: ExampleShapes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights, landmarks = planted(examples)
    examples.save(tmp_path / "examples.json")
    track = Track(LANDMARK_NAMES, landmarks.float(), torch.ones(9, 68))
    save_landmarks_csv(Take(30.0, landmarks=track), tmp_path / "landmarks.csv")
    words = [
        "--solver",
        "examples",
        "--examples",
        tmp_path / "examples.json",
        "--landmarks",
        tmp_path / "landmarks.csv",
    ]
    main(["track", *map(str, words), "--out", str(tmp_path / "out"), "--quiet"])
    assert "ms a frame" in capsys.readouterr().err
    take = load_take(tmp_path / "out" / "weights.csv")
    assert take.weights.names == examples.names
    assert (take.weights.values[..., 0] - weights).abs().max() < 0.05
    rows = {row["method"]: row for row in csv.DictReader((tmp_path / "out" / "methods.csv").open())}
    assert list(rows) == ["all", "regional", "linear"]
    assert float(rows["all"]["pixels"]) <= min(float(row["pixels"]) for row in rows.values())
    with pytest.raises(ValueRangeError, match="found no examples"):
        track_by_examples(None, [], tmp_path / "none", landmarks=str(tmp_path / "landmarks.csv"))
