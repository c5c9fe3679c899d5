"""Expression scans: names or a table say what they show, mirrored ones are found, what they do not show is left out."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import BlendshapeRig, TorchfaceError
from torchface.errors import AlignmentError, FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.shape_names import mirror
from torchface.synthetic import performer
from torchface.workflows.rig.expression_scans import (
    check_expression,
    check_side,
    expressions_in,
    neutral_in,
    seen_example,
    shared_notes,
)

NAMES = ("jawOpen", "browInnerUp_L", "browInnerUp_R", "mouthSmile_L")


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).write_text("x")


def test_names_tell_shapes_and_weights_in_any_spelling(tmp_path: Path) -> None:
    touch(tmp_path, "jawOpen=0.6+mouthSmileLeft=0.5.obj", "browInnerUp.ply", "Neutral.obj", "jawOpen.ljson", "a.txt")
    touch(tmp_path, "._Neutral.obj", "._browInnerUp.ply")
    first, second = expressions_in(tmp_path, NAMES)
    torch.testing.assert_close(first.weights, torch.tensor([0, 1.0, 1, 0]))
    torch.testing.assert_close(second.weights, torch.tensor([0.6, 0, 0, 0.5]))
    assert first.name == "browInnerUp"
    assert neutral_in(tmp_path) == tmp_path / "Neutral.obj"


def test_a_table_tells_them_in_its_order(tmp_path: Path) -> None:
    touch(tmp_path, "b.obj", "a.obj", "unused.obj")
    (tmp_path / "weights.csv").write_text("scan,jawOpen,mouthSmileLeft\nb.obj,0.7,\na.obj,0,1\n")
    found = expressions_in(tmp_path, NAMES)
    assert [one.name for one in found] == ["b", "a"]
    torch.testing.assert_close(found[0].weights, torch.tensor([0.7, 0, 0, 0]))
    torch.testing.assert_close(found[1].weights, torch.tensor([0.0, 0, 0, 1]))


@pytest.mark.parametrize(
    ("names", "table", "kind", "message"),
    [
        (("smile_01.obj",), None, NameMismatchError, "expected shapes of the template such as jawOpen"),
        (("jawOpen=much.obj",), None, ValueRangeError, "expected SHAPE=WEIGHT"),
        (("jawOpen=2.obj",), None, ValueRangeError, "expected weights from 0 to 1"),
        (("jawOpen=nan.obj",), None, ValueRangeError, "expected weights from 0 to 1"),
        (("jawOpen=0.obj",), None, ValueRangeError, "no weight above 0"),
        (("a.obj",), "scan,jawOpen\nb.obj,1\n", FileFormatError, "found 'b.obj' in the column scan"),
        (("a.obj",), "scan,jawOpen\n../a.obj,1\n", FileFormatError, "expected a file of the same folder"),
        (("a.obj",), "file,jawOpen\na.obj,1\n", FileFormatError, "no column 'scan'"),
        (("a.obj",), "scan,smile\na.obj,1\n", NameMismatchError, "found 'smile'"),
        (("a.obj",), "scan,jawOpen\na.obj,-1\n", ValueRangeError, "expected weights from 0 to 1"),
        (("jawOpen=0.5+jawOpen=0.2.obj",), None, ValueRangeError, "'jawOpen' twice in its name"),
        (("a.obj",), "scan,jawOpen\na.obj,much\n", TorchfaceError, "much"),
        (("a.obj",), "scan,jawOpen\na.obj,1\na.obj,0.5\n", FileFormatError, "more than one row for a.obj"),
        (("a.obj",), "scan,jawOpen\na.obj,\n", ValueRangeError, "no weight above 0"),
    ],
)
def test_mistakes_are_told(
    tmp_path: Path, names: tuple[str, ...], table: str | None, kind: type[TorchfaceError], message: str
) -> None:
    touch(tmp_path, *names)
    if table is not None:
        (tmp_path / "weights.csv").write_text(table)
    with pytest.raises(kind, match=message):
        expressions_in(tmp_path, NAMES)
    with pytest.raises(FileFormatError, match="no such folder"):
        expressions_in(tmp_path / "none", NAMES)


@pytest.fixture(scope="module")
def actor() -> BlendshapeRig:
    return performer(texture=False)


def weights(actor: BlendshapeRig, **given: float) -> Tensor:
    row = torch.zeros(len(actor.names))
    for name, value in given.items():
        row[actor.index([name])[0]] = value
    return row


def shown(actor: BlendshapeRig, row: Tensor) -> Tensor:
    noise = 0.3 * torch.randn(actor.vertices.shape, generator=torch.Generator().manual_seed(0))
    return actor(row[None])[0] + noise


ONE_SIDED: tuple[dict[str, float], ...] = (
    {"mouthSmileLeft": 0.8},
    {"jawRight": 0.8},
    {"jawOpen": 0.5, "browDownLeft": 1.0, "mouthSmileRight": 0.6},
)


@pytest.mark.parametrize("given", ONE_SIDED)
def test_the_other_side_is_told_with_both_distances(actor: BlendshapeRig, given: dict[str, float]) -> None:
    asked = weights(actor, **given)
    seen = torch.ones(len(actor.vertices), dtype=torch.bool)
    # Another person shows two thirds of it.
    check_side(actor, asked, shown(actor, asked * 2 / 3), seen)
    other = asked[mirror(actor.names)]
    with pytest.raises(
        AlignmentError,
        match=r"other side: \S+ mm \(root mean square, across the skin\) .*, \S+ mm from the mirror image",
    ):
        check_side(actor, asked, shown(actor, other * 2 / 3), seen)
    check_side(actor, asked, shown(actor, other), ~seen)  # what the scan does not show says nothing


@pytest.mark.parametrize("given", [{"jawOpen": 1.0}, {"mouthSmileLeft": 0.5, "mouthSmileRight": 0.5}, {}])
def test_a_symmetric_expression_tells_nothing(actor: BlendshapeRig, given: dict[str, float]) -> None:
    seen = torch.ones(len(actor.vertices), dtype=torch.bool)
    check_side(actor, weights(actor, **given), shown(actor, weights(actor, mouthSmileRight=1.0)), seen)


def test_another_expression_or_a_face_at_rest_by_its_name_is_told(actor: BlendshapeRig) -> None:
    seen = torch.ones(len(actor.vertices), dtype=torch.bool)
    jaw, brow = weights(actor, jawOpen=0.9), weights(actor, browInnerUp=0.9)
    for strength in (0.6, 1.4):  # another person's strength
        check_expression(actor, jaw, shown(actor, jaw * strength), seen)
    check_expression(actor, brow, shown(actor, brow), seen)
    said = r"something else: \S+ mm \(root mean square, across the skin\) .*, \S+ mm from the face at rest"
    for asked, found in ((brow, jaw), (jaw, brow), (jaw, jaw * 0)):
        with pytest.raises(AlignmentError, match=said):
            check_expression(actor, asked, shown(actor, found), seen)


def test_seen_vertices_keep_their_offset_and_unseen_ones_return_to_what_was_expected(dome_rig: BlendshapeRig) -> None:
    expected = dome_rig.vertices.double()
    seen = expected[:, 0] < 0
    noise = torch.randn(expected.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    smooth = torch.stack([torch.zeros(len(expected)), expected[:, 1].sin() * 0, expected[:, 1] / 25], dim=-1)
    offset = torch.where(seen[:, None], smooth, 3 * noise)
    found = dome_rig.neutral.with_vertices(expected + offset)
    example = seen_example(found, expected, seen)
    deep = expected[:, 0] < -10
    assert float((example - expected - smooth)[deep].norm(dim=-1).max()) < 0.06
    far = expected[:, 0] > 45
    assert float((example - expected)[far].norm(dim=-1).max()) < 0.5
    everything = seen_example(
        found, expected, torch.ones(len(expected), dtype=torch.bool), data_weight=1e6, damping=1e-6
    )
    torch.testing.assert_close(everything, found.vertices, atol=1e-3, rtol=0)
    nothing = seen_example(found, expected, torch.zeros(len(expected), dtype=torch.bool))
    torch.testing.assert_close(nothing, expected, atol=1e-9, rtol=0)


def test_it_is_the_optimum_of_its_cost(dome_rig: BlendshapeRig) -> None:
    expected = dome_rig.vertices.double()
    generator = torch.Generator().manual_seed(1)
    offset = torch.randn(expected.shape, generator=generator, dtype=torch.float64)
    seen = torch.rand(len(expected), generator=generator) > 0.4
    best = seen_example(dome_rig.neutral.with_vertices(expected + offset), expected, seen, 3.0, 0.2) - expected
    y = best.clone().requires_grad_()
    faces = dome_rig.neutral.faces
    pairs = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values.unique(dim=0)
    cost = 3 * (y - offset)[seen].square().sum() + (y[pairs[:, 0]] - y[pairs[:, 1]]).square().sum()
    (slope,) = torch.autograd.grad(cost + 0.2 * y.square().sum(), y)
    assert float(slope.abs().max()) < 1e-9


def test_other_shapes_are_refused(dome_rig: BlendshapeRig) -> None:
    with pytest.raises(ShapeError, match="seen_example"):
        seen_example(dome_rig.neutral, dome_rig.vertices[:5], torch.ones(5, dtype=torch.bool))


def test_what_every_example_shows_is_asked_of_the_neutral(tmp_path: Path) -> None:
    touch(tmp_path, "jawOpen.obj", "jawOpen=0.5+browInnerUp.obj", "jawOpen=0.5+mouthSmileLeft.obj")
    found = expressions_in(tmp_path, NAMES)
    (note,) = shared_notes(found, torch.zeros(4), NAMES)
    assert "--pose jawOpen=0.5 " in note
    assert shared_notes(found, torch.tensor([0.5, 0, 0, 0]), NAMES) == []
    assert shared_notes(found[:2], torch.zeros(4), NAMES) == []
    touch(tmp_path, "browInnerUp.obj")
    assert shared_notes(expressions_in(tmp_path, NAMES), torch.zeros(4), NAMES) == []
