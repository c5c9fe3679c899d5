"""The recipe for expressions on a handful of domes: a folder of pairs in, a table and a model out."""

import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchface import BlendshapeRig, Mesh, TorchfaceError, load_rig, save_mesh, save_rig, zoo
from torchface.errors import NameMismatchError, TopologyError
from torchface.modeling import ExpressionRegression, ExpressionSettings
from torchface.modeling.rigging import expression_training
from torchface.progress import silent
from train import expression as recipe
from train import expression_table, people_samples
from train.expression import Settings, Trained, fit, gather, selected, settle, train
from train.expression_table import METHODS


def turned(points: torch.Tensor, seed: int) -> torch.Tensor:
    angles = 0.05 * torch.randn(3, generator=torch.Generator().manual_seed(seed))
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -1.0, 0], [1, 0, 0], [0, 0, 0]]) * angles[0]
                                   + torch.tensor([[0, 0, 1.0], [0, 0, 0], [-1, 0, 0]]) * angles[1])  # fmt: skip
    return points @ turn.T + 2.0


@pytest.fixture(scope="module")
def pairs(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven people whose bulges grow with how high the dome is: folders of OBJ files, expressions in poses of their
    own; and one as .glb."""
    folder = tmp_path_factory.mktemp("pairs")
    heights = torch.linspace(0.8, 1.25, 8)
    for i, height in enumerate(heights.tolist()):
        neutral = dome_rig.neutral.with_vertices(dome_rig.vertices * torch.tensor([1.0, 1.0, height]))
        deltas = dome_rig.deltas * (0.4 + 2 * (height - 0.7))
        if i == 7:
            save_rig(BlendshapeRig(neutral, deltas, dome_rig.names), folder / "person7.glb")
            continue
        person = folder / f"person{i}"
        person.mkdir()
        save_mesh(neutral, person / "neutral.obj")
        for row, (name, delta) in enumerate(zip(dome_rig.names, deltas, strict=True)):
            moved = turned(neutral.vertices + delta, 10 * i + row)
            save_mesh(neutral.with_vertices(moved), person / f"{name}.obj")
    return folder


@pytest.fixture(scope="module")
def trained(pairs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Trained, Path]:
    out = tmp_path_factory.mktemp("models") / "domes"
    asked = ("jawOpen", "mouthSmileLeft+mouthSmileRight")
    frame = expression_table.frame_face
    with pytest.MonkeyPatch.context() as patch:  # small pictures are drawn sooner
        patch.setattr(expression_table, "frame_face", lambda mesh, yaw, **_: frame(mesh, yaw, width=60, height=72))
        return train(Settings(pairs=pairs, expressions=asked, out=out, pictured=1)), out


def test_the_law_is_found(trained: tuple[Trained, Path]) -> None:
    comparison = trained[0].comparison
    assert comparison.squared.shape == (8, 2, 3)
    assert comparison.counts[2] >= 14
    assert comparison.sums[2] < 0.1 * comparison.sums[1]
    assert all(method in str(comparison) for method in METHODS)


def test_the_model_lies_in_its_folder(trained: tuple[Trained, Path], dome_rig: BlendshapeRig) -> None:
    model, out = trained[0].model, trained[1]
    again = zoo.get_model(out)
    assert again.names == ("jawOpen", "mouthSmileLeft+mouthSmileRight")
    neutral = dome_rig.vertices[None]
    torch.testing.assert_close(again(neutral), model(neutral), rtol=0, atol=0.02)
    record = zoo.describe(out)
    assert record.metrics["lowest error of 16 cases, share: regression"] >= 14 / 16
    assert "--expressions jawOpen mouthSmileLeft+mouthSmileRight" in record.recipe
    assert (out / "pictures" / "jawOpen.png").stat().st_size > 1000


def test_a_template_gives_the_sum_where_people_have_a_combination(
    pairs: Path, dome_rig: BlendshapeRig, tmp_path: Path
) -> None:
    both = "mouthSmileLeft+mouthSmileRight"
    people = Settings(pairs=tmp_path / "people", template=tmp_path / "template.glb", out=tmp_path / "own", pictured=0)
    people.pairs.mkdir()
    for i in range(4):
        person = people.pairs / f"person{i}"
        person.mkdir()
        shutil.copy(pairs / f"person{i}" / "neutral.obj", person)
        shutil.copy(pairs / f"person{i}" / "mouthSmileLeft.obj", person / f"{both}.obj")
    save_rig(dome_rig, people.template)
    whole = selected(dome_rig, (both,), people.template)
    assert torch.equal(whole.deltas[0], dome_rig.deltas[2] + dome_rig.deltas[3])
    save_rig(whole, tmp_path / "combined.glb")
    found = [train(replace(people, template=tmp_path / f"{name}.glb")) for name in ("template", "combined")]
    assert found[0].comparison.names == (both,)
    torch.testing.assert_close(found[0].comparison.squared, found[1].comparison.squared, rtol=1e-5, atol=0)
    save_rig(dome_rig.select(["jawOpen", "mouthSmileLeft"]), people.template)
    with pytest.raises(NameMismatchError, match=r"template\.glb: found no shape 'mouthSmileRight' among 2"):
        train(people)
    save_rig(
        BlendshapeRig(Mesh(dome_rig.vertices, dome_rig.neutral.faces[2:]), dome_rig.deltas, dome_rig.names),
        people.template,
    )
    with pytest.raises(TopologyError, match=r"template\.glb: found 625 vertices and .* expected those of person0"):
        train(people)


def test_expressions_are_laid_onto_neutrals(dome_rig: BlendshapeRig) -> None:
    moved = dome_rig.vertices + dome_rig.deltas[2]
    back = settle(dome_rig.vertices, turned(moved, 3))
    assert (back - moved).norm(dim=-1).max() < 0.1
    assert (settle(dome_rig.vertices, moved) - moved).norm(dim=-1).max() < 0.1
    assert torch.equal(settle(dome_rig.vertices, dome_rig.vertices), dome_rig.vertices)


def test_more_components_than_people_are_cut(pairs: Path, tmp_path: Path) -> None:
    people = gather(Settings(pairs=pairs), tmp_path, silent)
    model = fit(people, Settings(pairs=pairs, neutral_components=50))
    assert len(model.neutral_components) <= 7
    chosen = fit(people, Settings(pairs=pairs, neutral_components=None, offset_components=None, ridge=None))
    assert len(chosen.neutral_components) <= 6


def test_people_who_do_not_fit_are_named(pairs: Path, dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    with pytest.raises(TorchfaceError, match="expected one: --pairs DIR or --performers"):
        train(Settings())
    with pytest.raises(TorchfaceError, match="found 0 people, expected at least three"):
        train(Settings(pairs=tmp_path, out=tmp_path.parent / "own"))
    with pytest.raises(NameMismatchError, match="tongueOut"):
        train(Settings(pairs=pairs, expressions=("tongueOut",), out=tmp_path / "own"))
    for i in range(3):
        neutral = dome_rig.neutral
        if i == 2:
            neutral = replace(neutral, faces=neutral.faces[:-2], polygons=None)
        save_rig(BlendshapeRig(neutral, dome_rig.deltas, dome_rig.names), tmp_path / f"{i}.glb")
    with pytest.raises(TorchfaceError, match=r": 2\.glb: found 625 vertices and .* expected those of 0\.glb"):
        train(Settings(pairs=tmp_path, out=tmp_path.parent / "own"))


def people_of(rigs: list[BlendshapeRig], folder: Path) -> Settings:
    """Settings for people of these rigs, p0 on, that learn nothing but what is needed."""
    folder.mkdir(exist_ok=True)
    for i, rig in enumerate(rigs):
        save_rig(rig, folder / f"p{i}")
    return Settings(pairs=folder, out=folder.parent / "own", compared=False)


def test_a_persons_unit_hand_order_and_names_are_said_with_the_person(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    vertices, names = dome_rig.vertices + torch.tensor([0, 0, 0.2]) * dome_rig.vertices[:, :1], dome_rig.names
    people = [
        BlendshapeRig(dome_rig.neutral.with_vertices(vertices * height), dome_rig.deltas, names)
        for height in (0.9, 1.0, 1.1, 1.2)
    ]
    mirror = torch.tensor([-1.0, 1.0, 1.0])
    neutral = people[2].neutral

    def asked(other: BlendshapeRig, folder: str) -> Settings:
        return people_of([*people[:2], other, people[3]], tmp_path / folder)

    def named(*new: str) -> BlendshapeRig:
        return BlendshapeRig(neutral, dome_rig.deltas, new)

    for changed, expected in (
        (lambda points: 1e-3 * points, r"p2: found an extent of .* in metres \(scale this one by 1000\)"),
        (lambda points: points * mirror, "p2: found a mirror image of p0's"),
    ):
        other = BlendshapeRig(neutral.with_vertices(changed(vertices)), changed(dome_rig.deltas), names)
        with pytest.raises(TorchfaceError, match=expected) as raised:
            train(asked(other, "wrong"))
        assert "--unit" not in str(raised.value)
        shutil.rmtree(tmp_path / "wrong")
    with pytest.raises(
        TorchfaceError, match=r"all 4 people have.*: p2 lacks browInnerUp, .*\(it has a1, a2, a3, a4 inst"
    ):
        train(asked(named("a1", "a2", "a3", "a4"), "foreign"))
    with pytest.warns(UserWarning, match=r"jawOpen left out: p2 lacks jawOpen \(it has jawopen instead\)"):
        assert len(train(asked(named("jawopen", *names[1:]), "lacking")).model.names) == 3
    with pytest.warns(UserWarning, match="p2 moves unlike .*jawOpen as their browInnerUp .*, browInnerUp as their jaw"):
        train(asked(named(names[1], names[0], *names[2:]), "exchanged"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(people_of(people[:3], tmp_path / "good"))
    for few in (0, 1, 2):
        with pytest.raises(TorchfaceError, match=r"neither --pairs|found [12], expected at least 3"):
            train(Settings(performers=few, out=tmp_path / "own"))


def test_people_on_disk_give_what_people_in_memory_give(
    pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = gather(Settings(pairs=pairs), tmp_path, silent)
    monkeypatch.setattr(people_samples, "_HELD_BYTES", 0)
    read_again: list[str] = []
    monkeypatch.setattr(recipe, "load_rig", lambda path: read_again.append(path.name) or load_rig(path))
    (tmp_path / "person_000005.safetensors").write_bytes(b"cut")
    with pytest.warns(UserWarning, match="damaged checkpoint"):
        kept = gather(Settings(pairs=pairs), tmp_path, silent)
    assert read_again == ["person0", "person5"]  # the first is every run's template
    assert not isinstance(kept.offsets, type(held.offsets))
    for i in range(8):
        assert torch.equal(kept.offsets_of(i), held.offsets_of(i))
        assert torch.equal(kept.without(i).offsets.read(0, 7), held.without(i).offsets.read(0, 7))
        assert torch.equal(kept.without(i).neutrals.read(2, 6), held.without(i).neutrals.read(2, 6))
    asked = Settings(pairs=pairs, neutral_components=None, offset_components=None, ridge=None)
    faces = held.expressions.read(0, 8).unflatten(1, (len(held.names), -1))
    whole = ExpressionRegression.fit(
        held.neutrals.read(0, 8), faces, ExpressionSettings(neutral_components=None, offset_components=None, ridge=None)
    )
    monkeypatch.setattr(expression_training, "_HELD_BYTES", 0)
    for people in (held, kept):
        for name, value in fit(people, asked).state_dict().items():
            torch.testing.assert_close(value, whole.state_dict()[name], msg=name)


def test_of_many_people_the_last_are_left_out_together(
    pairs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(expression_table, "_MANY", 7)
    monkeypatch.setattr(expression_table, "_TESTED", 2)
    found = train(Settings(pairs=pairs, out=tmp_path / "own", pictured=0)).comparison
    assert (len(found.squared), found.learned) == (2, 6)
    rest = gather(Settings(pairs=pairs), tmp_path / "work", silent).first(6)
    assert rest.who[-1] == "person5"
    mean = found.squared[:, :, METHODS.index("mean offset")]
    people = gather(Settings(pairs=pairs), tmp_path / "work", silent)
    truth = (people.offsets_of(7) - rest.mean_rig().deltas).double().square().sum((-1, -2))
    torch.testing.assert_close(mean[1], truth)
    assert "leaving out the last 2 people together" in (tmp_path / "own" / "CARD.md").read_text()
