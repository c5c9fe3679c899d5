"""The 16 and their meaning, the file of examples, examples of rigs and of people, and what landmarks tell apart."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchface.capture import ExampleSolver
from torchface.capture.anybody import (
    ExampleShapes,
    SolvedSimilarity,
    character_matrix,
    example_remarks,
    landmark_observability,
    paper_examples,
    paper_expressions,
    rig_examples,
    shown_examples,
)
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, TorchfaceError, ValueRangeError
from torchface.landmarks.images.ibug_68 import MIRROR_68
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT


def test_the_sixteen_are_in_the_papers_order_and_mean_shapes_of_arkit() -> None:
    names = [one.name for one in paper_expressions()]
    assert names[:6] == [
        "neutral",
        "brow_lower_left",
        "brow_raise_left",
        "brow_lower_right",
        "brow_raise_right",
        "suck",
    ]
    assert names[6:12] == ["pull_open", "pull_left", "pull_right", "lower_lip_depress", "pucker", "stretch"]
    assert names[12:] == ["rotate_left", "rotate_right", "tilt_left", "tilt_right"]
    assert all(set(one.shapes) <= set(ARKIT) and one.prompt for one in paper_expressions())
    turns = [(one.yaw, one.roll) for one in paper_expressions() if one.name in names[12:]]
    assert turns == [(20, 0), (-20, 0), (0, 15), (0, -15)]


def test_weights_of_examples_drive_a_character_by_name(performer_rig: BlendshapeRig, examples: ExampleShapes) -> None:
    """Whatever the order and count of its shapes: what the character then shows is the example."""
    shuffled = performer_rig.select(performer_rig.names[::-1])
    matrix = character_matrix(examples.names, shuffled.names)
    assert matrix.shape == (len(shuffled.names), 15)
    assert not matrix[:, 11:].any()
    again = paper_examples(shuffled)
    assert torch.allclose(again.landmarks, examples.landmarks, atol=1e-3)
    shown = rig_examples(
        BlendshapeRig(shuffled.neutral, torch.einsum("nk,nvc->kvc", matrix, shuffled.deltas), examples.names),
        examples.names[:11],
    )
    assert torch.allclose(shown.landmarks[:11], examples.landmarks[:11], atol=1e-3)
    assert character_matrix(["jawOpen"], ["x", "jawOpen"]).tolist() == [[0.0], [1.0]]
    halves = character_matrix(["brow_raise_left"], ["browInnerUp_L", "browOuterUp_L"])
    assert halves.flatten().tolist() == pytest.approx([0.4, 1.0])
    assert torch.equal(character_matrix(examples.names, examples.names), torch.eye(15))  # shapes of the same names
    with pytest.raises(NameMismatchError, match="expected ARKit's names"):
        character_matrix(examples.names, ["a", "b"])


def test_a_file_holds_them(examples: ExampleShapes, tmp_path: Path) -> None:
    examples.save(tmp_path / "examples.json")
    again = ExampleShapes.load(tmp_path / "examples.json")
    assert again.names == examples.names
    assert (again.landmarks - examples.landmarks).abs().max() < 1e-4
    assert (again.neutral - examples.neutral).abs().max() < 1e-4


@given(data=st.data())
@settings(max_examples=12)
def test_a_damaged_file_is_refused(
    examples: ExampleShapes, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "examples.json"
    examples.save(path)
    document = json.loads(path.read_text())
    key = data.draw(st.sampled_from(["format", "names", "neutral", "landmarks", "more"]))
    wrong = st.sampled_from([None, 3, "x", [], {}, [[]], [None] * 15, ["a"] * 15, 1e300, [[1, 2]] * 68])
    value = data.draw(wrong)
    if key == "neutral" and value == [[1, 2]] * 68:
        value = [[1, 2]] * 67
    document[key] = value
    path.write_text(json.dumps(document))
    with pytest.raises(TorchfaceError, match=r"examples\.json"):
        ExampleShapes.load(path)


def test_examples_in_another_order_or_count(examples: ExampleShapes) -> None:
    assert torch.equal(examples.select(["pucker", "suck"]).landmarks, examples.landmarks[[9, 4]])
    with pytest.raises(NameMismatchError, match="no 'smile' among 15 expressions"):
        examples.select(["pucker", "smile"])
    with pytest.raises(NameMismatchError, match="14 names for 15 expressions"):
        replace(examples, names=examples.names[:14])
    with pytest.raises(NameMismatchError, match="'suck' more than once"):
        replace(examples, names=("suck", *examples.names[1:]))
    with pytest.raises(ShapeError):
        replace(examples, neutral=examples.neutral[:67])
    with pytest.raises(ValueRangeError, match="NaN or infinite landmarks in pucker"):
        replace(examples, landmarks=examples.landmarks.index_fill(0, torch.tensor([9]), math.nan))
    with pytest.raises(ValueRangeError, match="seen from the front"):
        replace(examples, neutral=torch.zeros(68, 2))


def test_any_rigs_shapes_are_examples_with_turns_of_the_head(performer_rig: BlendshapeRig) -> None:
    made = rig_examples(performer_rig, ["jawOpen", "mouthSmileLeft"])
    assert made.names == ("jawOpen", "mouthSmileLeft", "rotate_left", "rotate_right", "tilt_left", "tilt_right")
    move = dict(zip(made.names, made.landmarks - made.neutral, strict=True))
    assert move["jawOpen"][8, 1] > 5  # the chin goes down
    assert move["mouthSmileLeft"][54].norm() > 3 * move["mouthSmileLeft"][48].norm()
    # The nose goes to the person's left, the picture's right, farther than the eyes behind it.
    assert move["rotate_left"][30, 0] - move["rotate_left"][[36, 45], 0].mean() > 5
    # Toward the person's left shoulder the left eye sinks below the right.
    assert move["tilt_left"][45, 1] > 0 > move["tilt_left"][36, 1]
    every = rig_examples(performer_rig)
    assert "tongueOut" not in every.names
    assert len(every.names) > 40


def test_heads_of_a_person_are_brought_to_one_place(examples: ExampleShapes) -> None:
    names = ["neutral", *examples.names]
    shapes = torch.cat([examples.neutral[None], examples.landmarks]).double()
    # The paper's expressions move nose and corners of the eyes a little: here not at all.
    still = [*range(27, 36), 36, 39, 42, 45]
    shapes[1:12, still] = shapes[0, still]
    generator = torch.Generator().manual_seed(0)
    moved = []
    for name, shape in zip(names, shapes, strict=True):
        angle, size = 0.2 * torch.randn(2, generator=generator).double()
        turn = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()]).reshape(2, 2) * (1 + size)
        turn = torch.eye(2).double() if name == "neutral" or name.startswith(("rotate", "tilt")) else turn
        shift = torch.zeros(2) if name == "neutral" else 50 * torch.randn(2, generator=generator)
        moved.append(shape @ turn.T + shift)
    order = torch.randperm(16, generator=generator).tolist()
    found = shown_examples([names[i] for i in order], torch.stack(moved)[order]).select(examples.names)
    assert torch.allclose(found.landmarks[:11], shapes[1:12].float(), atol=1e-3)
    apart = found.landmarks[11:] - shapes[12:].float()
    assert torch.allclose(apart, apart.mean(1, keepdim=True), atol=1e-3)
    with pytest.raises(NameMismatchError, match="expected 'neutral' among them"):
        shown_examples(["a", "b"], torch.rand(2, 68, 2))


def test_mirrored_pictures_and_faces_at_rest_are_remarked(examples: ExampleShapes) -> None:
    assert example_remarks(examples) == []
    flipped = torch.cat([examples.neutral[None], examples.landmarks])[:, list(MIRROR_68)] * torch.tensor([-1.0, 1.0])
    mirrored = ExampleShapes(examples.names, flipped[0], flipped[1:])
    assert any("mirrored pictures?" in line for line in example_remarks(mirrored))
    landmarks = examples.landmarks.clone()
    landmarks[4] = examples.neutral + 0.1
    assert any(
        "warning: suck hardly differ" in line for line in example_remarks(replace(examples, landmarks=landmarks))
    )


def test_what_landmarks_cannot_tell_apart_is_named(examples: ExampleShapes) -> None:
    half = examples.neutral + 0.5 * (examples.landmarks[9] - examples.neutral)
    names = (*examples.names, "half_pucker")
    more = ExampleShapes(names, examples.neutral, torch.cat([examples.landmarks, half[None]]))
    report = landmark_observability(ExampleSolver(more))
    assert (report.rank, report.condition) == (15, math.inf)
    assert {"pucker", "half_pucker"} <= set(report.ambiguous)
    assert set(report.confusions[0].names) == {"pucker", "half_pucker"}
    assert "68 landmarks see" in str(report)
    assert "% of the eyes' distance" in str(report)
    tilts = {"tilt_left", "tilt_right"}
    assert not tilts & {*landmark_observability(ExampleSolver(examples)).unseen}
    beside = landmark_observability(ExampleSolver(examples, None, SolvedSimilarity()))
    assert tilts <= {*beside.unseen}


def test_a_file_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text('{"format": "torchface.attachment/1"}')
    with pytest.raises(FileFormatError, match=r"torchface\.examples/1"):
        ExampleShapes.load(tmp_path / "other.json")
