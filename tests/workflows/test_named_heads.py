"""The head model that is taken where nobody names one."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import zoo
from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.io import load_ict_facekit
from torchface.modeling import HeadModel, MorphableModel
from torchface.synthetic import performer
from torchface.workflows.named_heads import NamedHeads, in_one_tile, matching
from train.morphable import Settings


def test_people_go_before_performers_and_models_with_a_rig_before_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(zoo.HOME, str(tmp_path))
    before = NamedHeads.of(None)
    assert before.name == "head"
    assert "torchface train morphable --ict FaceXModel" in before.line
    template = performer(texture=False).select(["jawOpen"])
    shape = MorphableModel(
        template.vertices, torch.eye(1)[:, :, None].expand(1, len(template.vertices), 3), torch.ones(1)
    )
    card = zoo.ModelCard("MIT", "3 people.", {"shape components": 1.0}, "none")
    zoo.save_model(HeadModel.on(template.neutral, shape), tmp_path / "bare", card)
    assert NamedHeads.of(None).name == "bare"
    zoo.save_model(HeadModel.on(template.neutral, shape, rig=template), tmp_path / "people", card)
    made_up = zoo.ModelCard("MIT", "performers", {"shape components": 9.0}, "none", settings={"performers": 9})
    zoo.save_model(HeadModel.on(template.neutral, shape, rig=template), tmp_path / "more", made_up)
    chosen = NamedHeads.of(None)
    assert chosen.name == "people"
    assert chosen.line == "head model: people, 3 people; choose another with --model"
    assert NamedHeads.of("head") == NamedHeads("head")


def test_heads_of_ict_are_put_where_they_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(zoo.HOME, str(tmp_path))
    assert Settings(ict=tmp_path / "FaceXModel").out == tmp_path / "people"
    assert Settings(ict=tmp_path / "FaceXModel", out=Path("a")).out == Path("a")
    assert Settings(performers=3).out == Path("models/head")


@pytest.mark.real
def test_charts_of_an_ict_head_do_not_cover_each_other(data: Path) -> None:
    """Eyeballs lie over the face in ICT-FaceKit's own texture coordinates, and the neck in a further tile."""
    rig = load_ict_facekit(data / "ict_facekit" / "FaceXModel", shapes=["jawOpen"])
    shape = MorphableModel(rig.vertices, torch.zeros(1, *rig.vertices.shape), torch.ones(1))
    mesh = matching(HeadModel.on(rig.neutral, shape, rig=rig))[1].neutral
    assert 0 <= float(mesh.uvs.min()) <= float(mesh.uvs.max()) <= 1
    names = ("face", "head_and_neck", "eyeball_left", "eyeball_right", "teeth", "gums_and_tongue")
    inside = [mesh.annotations.regions[name][mesh.faces].all(1) for name in names]
    shown = torch.stack([rasterise_uvs(mesh.uvs, mesh.uv_faces[one], 512, 512).mask() for one in inside])
    assert int(shown.sum(0).max()) == 1


def squares(places: list[tuple[float, float]]) -> tuple[Tensor, Tensor]:
    """Two triangles each, a square of 0.8 in the texture at a place."""
    corner = torch.tensor([[0.0, 0.0], [0.8, 0.0], [0.8, 0.8], [0.0, 0.8]])
    uvs = torch.cat([corner + torch.tensor(place) + 0.1 for place in places])
    return uvs, torch.cat([torch.tensor([[0, 1, 2], [0, 2, 3]]) + 4 * number for number in range(len(places))])


def test_each_tile_and_each_kind_has_a_square_of_its_own() -> None:
    kind = torch.tensor([0, 1, 0, 2, 0]).repeat_interleave(2)
    uvs, rows = in_one_tile(*squares([(0, 0), (0, 0), (3, 0), (1, 0), (0, 1)]), kind)
    assert 0 <= float(uvs.min()) <= float(uvs.max()) <= 1
    covered = torch.stack([rasterise_uvs(uvs, rows[2 * k : 2 * k + 2], 256, 256).mask().long() for k in range(5)])
    assert int(covered.sum(0).max()) == 1  # no texel is of two charts
    corners = uvs[rows].reshape(5, 6, 2)
    extent = corners.amax(1) - corners.amin(1)
    torch.testing.assert_close(extent[:, 0], extent[:, 1])  # squares stay squares


def test_one_tile_stays_as_it_is() -> None:
    uvs, rows = squares([(0, 0), (0, 0)])
    assert in_one_tile(uvs, rows, torch.tensor([0, 0, 1, 1])) == (uvs, rows)
