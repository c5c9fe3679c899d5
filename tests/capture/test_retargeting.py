"""Weights on other rigs: split, merged, combined, gained and limited."""

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchface import BlendshapeRig, load_rig, load_take
from torchface.capture.retargeting import ShapeRule, load_shape_rules, shape_map
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, TorchfaceError, ValueRangeError
from torchface.shape_names import ARKIT
from torchface.synthetic import performer


def test_a_rig_on_itself_is_itself() -> None:
    weights = torch.rand(7, 52)
    assert torch.equal(shape_map(ARKIT, ARKIT)(weights), weights)


def test_the_performer_moves_alike_by_other_names_and_split_shapes() -> None:
    rig = performer()
    split = [n for name in rig.names for n in ((f"{name}_L", f"{name}_R") if name == "browInnerUp" else (name,))]
    deltas = {name: rig.deltas[i] for i, name in enumerate(rig.names)}
    x = rig.vertices[:, :1]
    brow = deltas["browInnerUp"]
    deltas |= {"browInnerUp_L": brow * (x > 0), "browInnerUp_R": brow * (x <= 0)}
    other = BlendshapeRig(rig.neutral, torch.stack([deltas[name] for name in split]), split)
    weights = torch.rand(5, len(rig.names), generator=torch.Generator().manual_seed(0))
    there = shape_map(rig.names, other.names)
    assert torch.allclose(other(there(weights)), rig(weights), atol=1e-4)
    back = shape_map(other.names, rig.names)
    assert torch.allclose(back(there(weights)), weights, atol=1e-6)


def test_combination_shapes_are_driven_by_products() -> None:
    base = ["jawOpen", "mouthSmileLeft", "mouthSmileRight"]
    shapes = shape_map(base, [*base, "jawOpen_mouthSmileLeft", "jawOpen+mouthSmileLeft+mouthSmileRight"])
    w = torch.tensor([[0.5, 0.4, 0.2]])
    assert shapes(w)[0, 3:].tolist() == pytest.approx([0.2, 0.04])
    sided = shape_map(base, ["jawOpen_mouthSmile_L", "mouthSmile_Left_mouthSmile_R_jawOpen"])
    assert sided(w)[0].tolist() == pytest.approx([0.2, 0.04])
    assert shapes.undriven == ()


def test_rules_in_a_table(tmp_path: Path) -> None:
    table = tmp_path / "table.toml"
    table.write_text(
        "[Smile]\nsum = {mouthSmileLeft = 0.5, mouthSmileRight = 0.5}\ngain = 2\nupper = 0.8\n"
        '[Laugh]\nproduct = ["jawOpen", "mouthSmileLeft"]\n'
        '[jawOpen]\nsum = {jawOpen = 1}\nproduct = ["mouthSmileLeft"]\nlower = 0.1\n'
    )
    base = ["jawOpen", "mouthSmileLeft", "mouthSmileRight", "cheekPuff"]
    shapes = shape_map(base, ["Smile", "Laugh", "jawOpen", "Wing"], load_shape_rules(table))
    moved = shapes(torch.tensor([[0.5, 0.4, 0.2, 0.9], [0.2, 0.2, 0.1, 0.0]]))
    assert torch.allclose(moved, torch.tensor([[0.6, 0.2, 0.2, 0.0], [0.3, 0.04, 0.1, 0.0]]))
    assert (shapes.undriven, shapes.unused) == (("Wing",), ("cheekPuff",))


def test_a_frame_that_was_not_seen_stays_unseen_where_it_matters() -> None:
    shapes = shape_map(["jawOpen", "jawLeft"], ["jawOpen", "jawLeft"])
    moved = shapes(torch.tensor([[torch.nan, 0.3]]))
    assert bool(moved[0, 0].isnan())
    assert float(moved[0, 1]) == pytest.approx(0.3)


def test_gradients_flow() -> None:
    shapes = shape_map(
        ["a", "b"], ["c", "d"], {"c": ShapeRule({"a": 0.4, "b": 0.3}), "d": ShapeRule(product=("a", "b"))}
    )
    weights = torch.rand(3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(shapes, (weights,))


def test_bad_tables(tmp_path: Path) -> None:
    def load(text: str) -> None:
        (tmp_path / "t.toml").write_text(text)
        load_shape_rules(tmp_path / "t.toml")

    for text, message in (
        ("[a", "not TOML"),
        ("a = 3", "expected a table with sum or product"),
        ("[a]\ngain = 2", "a = .*expected sum or product"),
        ('[a]\nsum = {b = "x"}', "a.sum.b = 'x', expected a factor"),
        ("[a]\nsum = {b = nan}", "a.sum.b = nan, expected a factor"),
        ('[a]\nproduct = "b"', "a list of source shapes"),
        ("[a]\nsum = {b = 1}\ngian = 2", "a.gian = 2, expected only sum, product"),
    ):
        with pytest.raises(FileFormatError, match=message):
            load(text)
    with pytest.raises(FileFormatError, match="no such file"):
        load_shape_rules(tmp_path / "other.toml")


def test_rules_that_do_not_fit() -> None:
    with pytest.raises(NameMismatchError, match="rules for wing"):
        shape_map(ARKIT, ARKIT, {"wing": ShapeRule({"jawOpen": 1})})
    with pytest.raises(NameMismatchError, match="names wing"):
        shape_map(ARKIT, ARKIT, {"jawOpen": ShapeRule({"wing": 1})})
    with pytest.raises(ValueRangeError, match="lower <= upper"):
        shape_map(ARKIT, ARKIT, {"jawOpen": ShapeRule({"jawOpen": 1}, lower=2)})
    with pytest.raises(NameMismatchError, match="a table that maps them"):
        shape_map(["a"], ["b"])
    with pytest.raises(ShapeError, match="expected \\(T,52\\)"):
        shape_map(ARKIT, ARKIT)(torch.zeros(2, 3))


@given(st.text(max_size=200))
def test_any_text_is_a_table_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "t.toml"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    try:
        rules = load_shape_rules(path)
    except TorchfaceError:
        return
    assert all(isinstance(rule, ShapeRule) for rule in rules.values())


@pytest.mark.bench
@pytest.mark.real
def test_a_real_performance_reaches_every_shape_that_both_rigs_have(ict_folder: Path, performances: list[Path]) -> None:
    rig = load_rig(ict_folder, part="face")
    track = load_take(performances[0]).weights
    shapes = shape_map(track.names, rig.names)
    assert set(shapes.undriven) == {"cheekRaiser_L", "cheekRaiser_R"} & set(rig.names)
    assert set(shapes.unused) == {"TongueOut"}
    assert torch.allclose(shapes(track.values[..., 0]), rig.weights_from(track).clamp(0, 1))


def test_a_table_may_spell_names_in_any_way_and_near_misses_are_told() -> None:
    source, target = ["MouthSmileLeft", "CheekSquintLeft"], ["mouthSmile_L", "smile_with_squint"]
    rules = {
        "mouthSmileLeft": ShapeRule({"mouthSmileLeft": 0.5, "cheekSquint_L": 0.25}),
        "smile_with_squint": ShapeRule(product=("mouthSmile_L", "CheekSquintLeft")),
    }
    found = shape_map(source, target, rules)(torch.tensor([[0.8, 0.5]]))
    torch.testing.assert_close(found, torch.tensor([[0.525, 0.4]]))
    with pytest.raises(NameMismatchError, match=r"names cheekSqint, expected .*: did you mean cheekSquintLeft\?"):
        shape_map(["mouthSmileLeft", "cheekSquintLeft"], target, {"mouthSmile_L": ShapeRule({"cheekSqint": 1.0})})
    with pytest.raises(NameMismatchError, match="two rules for mouthSmile_L"):
        shape_map(source, target, {"mouthSmileLeft": ShapeRule(), "MouthSmileLeft": ShapeRule()})
    with pytest.raises(NameMismatchError, match="names a shape twice"):
        shape_map(source, target, {"mouthSmile_L": ShapeRule({"mouthSmile_L": 1.0, "mouthSmileLeft": 1.0})})
