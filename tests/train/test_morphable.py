"""The recipe end to end: performers, registered meshes in any place and light, a killed run, bad input."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from forked_runs import killed
from scipy.spatial.transform import Rotation

from planted.published_heads import gnm_arrays, gnm_landmarks, head
from torchface import Mesh, load_mesh, save_mesh, zoo
from torchface.color_space import to_linear, to_srgb
from torchface.errors import AlignmentError, TopologyError, TorchfaceError, ValueRangeError
from torchface.geometry.similarity import similarity_transform
from torchface.io import load_identity_modes
from torchface.modeling import HeadModel, MorphableModel
from torchface.synthetic import draw_identities, neutral_head
from torchface.viz.figures import model_figures as model_pictures
from torchface.workflows.named_heads import load_head_model, matching
from train import morphable as recipe
from train.head_samples import Source, registered, upright, vertex_colored
from train.morphable import Settings, Trained, train
from train.rendered_people.complexion import complexion_colors, draw_complexions


def people(count: int) -> list[Mesh]:
    generator = torch.Generator().manual_seed(5)
    identities = draw_identities(count, generator)
    colors = complexion_colors(draw_complexions(count, generator))
    return [replace(neutral_head(i, texture=False), colors=c) for i, c in zip(identities, colors, strict=True)]


@pytest.fixture(scope="module")
def heads() -> list[Mesh]:
    return people(9)


@pytest.fixture(scope="module")
def folder(heads: list[Mesh], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The heads as registration leaves them: each in its scan's place, under its scan's light."""
    path = tmp_path_factory.mktemp("registered")
    turns = torch.from_numpy(Rotation.random(len(heads), rng=1).as_matrix()).float()
    generator = torch.Generator().manual_seed(2)
    for number, mesh in enumerate(heads):
        vertices = mesh.vertices @ turns[number].T + 80 * torch.randn(3, generator=generator)
        light = torch.exp(0.15 * torch.randn(3, generator=generator))
        colors = to_srgb(to_linear(mesh.colors) * light).clamp(0, 1)
        save_mesh(replace(mesh, vertices=vertices, colors=colors), path / f"scan_{number}.glb")
    return path


@pytest.fixture(scope="module")
def trained(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Trained, Path]:
    out = tmp_path_factory.mktemp("models") / "people"
    with pytest.MonkeyPatch.context() as patch:  # small pictures are drawn sooner
        patch.setattr(model_pictures, "_WIDTH", 44)
        patch.setattr(model_pictures, "_HEIGHT", 55)
        return train(Settings(scans=folder, out=out, held_out=2)), out


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recipe, "draw", lambda *parts: None)


def test_places_and_lights_of_the_scans_are_gone(trained: tuple[Trained, Path], heads: list[Mesh]) -> None:
    model = trained[0].model
    plain = MorphableModel.fit(torch.stack([mesh.vertices for mesh in heads[:7]]))
    # Performers stand where they stand; aligned to each other they differ by less, and in form alone.
    assert 0.5 * plain.total_variance < model.shape.total_variance < plain.total_variance
    assert model.shape.count == 6
    for mesh in heads[:7]:
        again = model.shape(model.shape.project(upright(mesh).vertices[None]))[0]
        sizes = torch.pdist(again[::200]), torch.pdist(mesh.vertices[::200])
        assert (sizes[0] - sizes[1]).abs().mean() < 1.5
    assert model.color.explained[2] > 0.6


def test_the_model_stands_upright_and_knows_its_landmarks(trained: tuple[Trained, Path], heads: list[Mesh]) -> None:
    mean = trained[0].model.template()
    marks = mean.vertices[mean.landmarks]
    assert marks[45, 0] - marks[36, 0] > 60  # x to the viewer's right
    assert marks[27, 1] - marks[8, 1] > 80  # y up
    assert marks[30, 2] - marks[[0, 16], 2].mean() > 60  # z toward the viewer
    assert mean.fingerprint() == heads[0].fingerprint()
    assert mean.polygons is not None


def test_the_folder_holds_model_card_and_pictures(trained: tuple[Trained, Path]) -> None:
    result, out = trained
    assert {p.name for p in out.iterdir()} == {
        "model.toml",
        "state.safetensors",
        "CARD.md",
        "pictures",
        "settings.toml",
        "log.csv",
    }
    assert not [p for p in out.parent.iterdir() if p != out]
    names = {"modes", "color_modes", "random", "morph", "far", "components", "quality"}
    assert {p.stem for p in (out / "pictures").iterdir()} == names
    again = zoo.get_model(out)
    assert isinstance(again, HeadModel)
    a = torch.randn(1, 6, generator=torch.Generator().manual_seed(0))
    assert torch.equal(again(a).vertices, result.model(a).vertices)
    assert zoo.describe(out).metrics == pytest.approx(result.metrics)
    assert result.metrics["held out, of the mean head's error"] < 1
    card = (out / "CARD.md").read_text()
    assert "torchface train morphable --scans" in card
    assert "Tested on 2 heads" in card


def test_performers_in_half_precision_are_learned_the_same_each_time(tmp_path: Path, without_pictures: None) -> None:
    settings = Settings(performers=6, held_out=2, components=4, half=True, out=tmp_path / "one")
    train(settings)
    other = replace(settings, seed=8, out=tmp_path / "two")
    for step, done in (("reading heads", 4), ("fitting principal components", 2)):  # of another seed, into the folder
        killed(lambda progress: train(other, progress), step, done)
    assert list((tmp_path / ".two.training").rglob("*.safetensors*"))
    again = train(replace(settings, out=tmp_path / "two"))
    assert zoo.describe(tmp_path / "one").sha256 == zoo.describe(tmp_path / "two").sha256
    loaded, a = zoo.get_model(tmp_path / "two"), torch.full((1, 4), 2.0)
    assert (loaded(a).vertices - again.model(a).vertices).abs().max() < 0.05


def test_a_killed_run_goes_on_where_it_was(
    folder: Path, tmp_path: Path, without_pictures: None, monkeypatch: pytest.MonkeyPatch, trained: tuple[Trained, Path]
) -> None:
    settings, read = Settings(scans=folder, out=tmp_path / "people", held_out=2), []

    def counted(path: Path, unit: str | None) -> Source:
        source = registered(path, unit)

        def one(number: int) -> Mesh:
            read.append(number)
            if len(read) == 6:
                raise KeyboardInterrupt
            return source.read(number)

        return replace(source, read=one)

    def stop(*parts: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(recipe, "registered", counted)
    with pytest.raises(KeyboardInterrupt):
        train(settings)
    assert read == [0, 1, 2, 3, 4, 5]
    with monkeypatch.context() as patch:
        patch.setattr(recipe, "aligned_samples", stop)
        with pytest.raises(KeyboardInterrupt):
            train(settings)
    assert read[6:] == [0, 5, 6, 7, 8]  # the first is the template
    again = train(settings)
    assert read[11:] == [0]
    assert torch.equal(again.model.shape.components, trained[0].model.shape.components)


def test_meshes_that_teach_nothing_are_named(heads: list[Mesh], tmp_path: Path, without_pictures: None) -> None:
    scans, settings = tmp_path / "scans", Settings(scans=tmp_path / "scans", out=tmp_path / "model", held_out=0)
    scans.mkdir()
    with pytest.raises(TorchfaceError, match="found no scan"):
        train(settings)
    save_mesh(heads[0], scans / "a.glb")
    with pytest.raises(TorchfaceError, match="found 1, expected at least two"):
        train(settings)
    save_mesh(heads[0], scans / "b.glb")
    save_mesh(heads[0], scans / "c.glb")
    with pytest.raises(ValueRangeError, match="found 3 that are all the same"):
        train(settings)
    with pytest.raises(TorchfaceError, match="components: found 3, expected 1 to 2 with 3 heads"):
        train(replace(settings, components=3))
    save_mesh(Mesh(heads[0].vertices, heads[0].faces[:-5]), scans / "d.glb")
    with pytest.raises(TopologyError, match=r"d\.glb: found 6419 vertices and 12755 triangles, expected.*12760"):
        train(settings)
    with pytest.raises(TorchfaceError, match="and a number of performers"):
        train(replace(settings, performers=5))


def test_a_mirrored_head_and_another_order_are_refused_and_a_far_one_is_named(
    heads: list[Mesh], tmp_path: Path, without_pictures: None
) -> None:
    scans, settings = tmp_path / "scans", Settings(scans=tmp_path / "scans", out=tmp_path / "model", held_out=1)
    scans.mkdir()
    for number, mesh in enumerate(heads[:6]):
        save_mesh(mesh, scans / f"{number}.glb")
    save_mesh(heads[3].with_vertices(heads[3].vertices * torch.tensor([-1.0, 1.0, 1.0])), scans / "3.glb")
    with pytest.raises(AlignmentError, match=r"3\.glb: found a mirror image of 0\.glb's"):
        train(settings)
    order = torch.randperm(len(heads[3].vertices), generator=torch.Generator().manual_seed(0))
    save_mesh(Mesh(heads[3].vertices[order], order.argsort()[heads[3].faces]), scans / "3.glb")
    with pytest.raises(
        TopologyError, match=r"3\.glb: found .* other triangles than 0\.glb, or the same in another order"
    ):
        train(settings)
    save_mesh(Mesh(heads[3].vertices[order], heads[3].faces), scans / "3.glb")
    with pytest.raises(AlignmentError, match=r"3\.glb: found .* vertices stand in another order than 0\.glb's"):
        train(settings)
    for number in (3, 5):  # the last is kept for the test
        save_mesh(heads[number].with_vertices(1.3 * heads[number].vertices), scans / f"{number}.glb")
        with pytest.warns(UserWarning, match=rf"1 of 6 heads lie far from every other one .*: {number}\.glb \d+ mm"):
            train(settings)
        save_mesh(heads[number], scans / f"{number}.glb")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(settings)


def test_meshes_without_colours_make_a_model_of_shape(
    heads: list[Mesh], tmp_path: Path, without_pictures: None
) -> None:
    for number, mesh in enumerate(heads[:4]):
        save_mesh(replace(mesh, colors=mesh.colors if number < 2 else None), tmp_path / f"{number}.glb")
    said: list[str] = []
    result = train(Settings(scans=tmp_path, out=tmp_path / "model", held_out=0), lambda step, *_: said.append(step))
    assert result.model.color is None
    assert "2.glb has no colours: the model will have none" in said


def test_few_heads_are_each_left_out_once(folder: Path, tmp_path: Path, without_pictures: None) -> None:
    result = train(Settings(scans=folder, out=tmp_path / "people"))
    assert result.metrics["left out in turn, heads"] == 9
    assert result.model.shape.count == 8  # all of them are in the model
    heads = [upright(vertex_colored(load_mesh(path))) for path in sorted(folder.iterdir())]
    laid = torch.stack([m.vertices for m in heads])
    laid = similarity_transform(laid, laid[:1].expand(laid.shape), scale=False).apply(laid)
    far = []
    for number in range(9):
        others = MorphableModel.fit(laid[torch.arange(9) != number])
        own = laid[number : number + 1]
        far.append((others(others.project(own)) - own).norm(dim=-1).mean())
    assert result.metrics["left out in turn, mean error mm"] == pytest.approx(float(torch.stack(far).mean()), rel=0.05)
    card = (tmp_path / "people" / "CARD.md").read_text()
    assert "Tested on all 9 heads, each left out of the model once, in 9 turns" in card


@pytest.mark.real
def test_the_real_heads_model_in_one_command(ict_folder: Path, tmp_path: Path, without_pictures: None) -> None:
    result = train(Settings(ict=ict_folder, out=tmp_path / "people", components=6))
    model = zoo.get_model(tmp_path / "people")
    modes = load_identity_modes(ict_folder, 6)
    a = torch.randn(6, generator=torch.Generator().manual_seed(1))
    lips = modes.neutral.vertices[modes.neutral.landmarks[48:]].mean(0)
    # About the mouth lips are made to meet, and upper teeth are longer.
    teeth = modes.neutral.regions["teeth"]
    as_given = ((modes.neutral.vertices - lips).norm(dim=1) > 40) & ~teeth
    found, given = model(a[None]).vertices[0], modes.head(a).vertices
    torch.testing.assert_close(found[as_given], given[as_given], rtol=0, atol=1e-3)
    torch.testing.assert_close(found[:, 0], given[:, 0], rtol=0, atol=1e-3)  # lips stay as wide
    assert (found - given)[~teeth].abs().max() < 2
    longer = (given - found)[teeth, 1]
    torch.testing.assert_close(longer, 2.0 * (longer > 1), rtol=0, atol=1e-3)
    assert len(model.rig.names) == 53
    assert torch.equal(model.rig.vertices[as_given], modes.neutral.vertices[as_given])
    assert torch.equal(model.rig.vertices, model.shape.mean)
    assert "MIT" in zoo.describe(tmp_path / "people").licence
    assert result.metrics["shape components"] == 6


@pytest.mark.real
def test_a_model_of_registered_faces_carries_the_templates_rig(
    ict_folder: Path, tmp_path: Path, without_pictures: None
) -> None:
    """What `register FaceXModel --part face` leaves, learned from; the model fits photographs without its template."""
    modes = load_identity_modes(ict_folder, 8, part="face")
    (tmp_path / "registered").mkdir()
    for seed in range(6):
        save_mesh(modes.random_head(seed), tmp_path / "registered" / f"scan_{seed}.glb")
    train(Settings(scans=tmp_path / "registered", template=ict_folder, part="face", out=tmp_path / "people"))
    model, rig = matching(load_head_model(tmp_path / "people"))
    assert len(rig.vertices) == len(model.shape.mean) == 9409
    assert len(rig.names) == 53


def test_meshes_in_centimetres_are_refused_and_read_with_their_unit(
    heads: list[Mesh], tmp_path: Path, without_pictures: None
) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    for number, mesh in enumerate(heads[:3]):
        save_mesh(mesh.with_vertices(mesh.vertices / 10), folder / f"{number}.obj")
    settings = Settings(scans=folder, out=tmp_path / "people", pictures=tmp_path)
    with pytest.raises(ValueRangeError, match=r"0\.obj: found an extent of .* in centimetres .*--unit cm"):
        train(settings)
    save_mesh(heads[0], tmp_path / "template.glb")
    with pytest.raises(ValueRangeError, match=r"0\.obj: found .* beside a template .* in centimetres"):
        train(replace(settings, template=tmp_path / "template.glb"))
    model = train(replace(settings, unit="cm")).model
    assert float((model.shape.mean - heads[0].vertices).norm(dim=1).mean()) < 10


def test_ict_among_scans_and_a_file_are_told(heads: list[Mesh], tmp_path: Path) -> None:
    (tmp_path / "vertex_indices.json").write_text("{}")
    with pytest.raises(TorchfaceError, match=r"found ICT-FaceKit's FaceXModel, .*take it by --ict"):
        registered(tmp_path)
    with pytest.raises(TorchfaceError, match="found a file, expected a folder of registered meshes"):
        registered(tmp_path / "vertex_indices.json")


@pytest.mark.bench
def test_a_published_model_gets_arkits_shapes_and_keeps_its_licence(tmp_path: Path, without_pictures: None) -> None:
    rig = head()
    np.savez(tmp_path / "gnm_head.npz", **gnm_arrays(rig))
    gnm_landmarks(rig, tmp_path / "head_sparse_68.txt")
    train(Settings(published=tmp_path / "gnm_head.npz", out=tmp_path / "people", components=4))
    model = zoo.get_model(tmp_path / "people", HeadModel)
    assert model.shape.count == 4
    assert len(model.rig.names) == 51
    assert "Apache-2.0" in (tmp_path / "people" / "CARD.md").read_text()
    with pytest.raises(TorchfaceError, match="--published"):
        train(Settings(published=tmp_path / "gnm_head.npz", performers=3, out=tmp_path / "both"))
