"""Maya's files read by a parser of their grammar, and what their nodes show."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from maya_scene import MayaScene, statements
from rig_samples import corrective_sheet, rigs, sheet_rig

from torchface import BlendshapeRig, Corrective, Correctives, Take, Track, save_animation, save_rig
from torchface.cli import main
from torchface.errors import FileFormatError
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.io.maya.maya_writing import maya_notes
from torchface.synthetic import performer

MILLIMETRES = 1e-4


def eight_drivers() -> BlendshapeRig:
    """The sheet with a product of eight and two in-betweens of one shape."""
    sheet, names = sheet_rig(), tuple("abcdefgh")
    deltas = torch.randn(11, len(sheet.vertices), 3, generator=torch.Generator().manual_seed(6))
    definitions = (Corrective("product", names), Corrective("a_30", ("a",), 0.3), Corrective("a_60", ("a",), 0.6))
    return BlendshapeRig(sheet.neutral, deltas[:8], names, Correctives(deltas[8:], definitions))


@pytest.mark.parametrize("made", [sheet_rig, eight_drivers])
def test_the_nodes_show_what_the_rig_does(made: object, tmp_path: Path) -> None:
    rig = made()
    save_rig(rig, tmp_path / "rig.ma")
    scene = MayaScene.read(tmp_path / "rig.ma")
    assert scene.unit == "centimeter"
    points, polygons, uv_polygons, uvs = scene.mesh()
    assert np.abs(10 * points - rig.vertices.numpy()).max() < MILLIMETRES
    expected = [[corner for corner in row if corner >= 0] for row in rig.neutral.polygons.tolist()]
    assert polygons == expected
    assert np.abs(uvs - rig.neutral.uvs.numpy()).max() < 1e-6
    corners = [row for polygon in uv_polygons for row in polygon[:2]]
    assert len(uv_polygons) == len(polygons)
    first = [polygon[0] for polygon in uv_polygons]
    starts = np.cumsum([0, *(len(row) - 2 for row in expected[:-1])])
    assert first == rig.neutral.uv_faces[torch.from_numpy(starts), 0].tolist()
    assert len(corners) == 2 * len(polygons)
    combinations = [] if rig.correctives is None else ["product"]
    assert scene.aliases() == [*rig.names, *combinations]
    for weights in torch.rand(3, len(rig.names), generator=torch.Generator().manual_seed(1)):
        shown = 10 * scene.face(weights.tolist().__getitem__)
        assert np.abs(shown - rig(weights[None])[0].numpy()).max() < 3 * MILLIMETRES


@pytest.mark.parametrize(
    ("fps", "rate", "per_second"), [(60.0, "ntscf", 60), (30000 / 1001, "29.97fps", 30000 / 1001), (61.7, "ntscf", 60)]
)
def test_curves_have_the_takes_keys_at_its_rate(fps: float, rate: str, per_second: float, tmp_path: Path) -> None:
    rig = eight_drivers()
    values = torch.rand(7, 8, 1, generator=torch.Generator().manual_seed(2))
    values[:, 5] = 0.0
    save_animation(rig, Take(fps, weights=Track(rig.names, values)), tmp_path / "take.ma")
    scene = MayaScene.read(tmp_path / "take.ma")
    assert scene.rate == rate
    curves = scene.of_kind("animCurveTU")
    assert set(curves) == {f"shapes_{name}" for name in "abcdegh"}  # f does not move
    for frame in range(7):
        shown = 10 * scene.face(frame=frame / fps * per_second)
        assert np.abs(shown - rig(values[frame].T)[0].numpy()).max() < 3 * MILLIMETRES


def test_names_are_made_mayas_without_collisions_and_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sheet = sheet_rig()
    names = ('jaw "open"\\', "jaw__open__", "1st", "weight", "ドア", "jaw__open___2", "")
    deltas = torch.randn(len(names), len(sheet.vertices), 3, generator=torch.Generator().manual_seed(3))
    rig = BlendshapeRig(sheet.neutral, deltas, names)
    save_rig(rig, tmp_path / "rig.ma")
    scene = MayaScene.read(tmp_path / "rig.ma")
    aliases = scene.aliases()
    assert aliases == ["jaw__open__", "jaw__open___2", "_1st", "weight_2", "__", "jaw__open___2_2", "shape"]
    assert len(set(aliases)) == len(names)
    (notes,) = scene.nodes["shapes"].values[".nts"]
    assert notes.splitlines()[:3] == ['jaw__open__ = jaw "open"\\', "jaw__open___2 = jaw__open__", "_1st = 1st"]
    shown = scene.face(lambda place: float(place == 3))
    assert np.abs(10 * shown - (rig.vertices + deltas[3]).numpy()).max() < MILLIMETRES
    save_rig(rig, tmp_path / "rig.glb")
    main(["convert", str(tmp_path / "rig.glb"), str(tmp_path / "again.ma"), "-q"])
    told = " ".join(capsys.readouterr().err.split())
    assert ".ma has other names for 7 shapes" in told
    assert ".ma has no place for the texture and vertex colours and annotations" in told


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rig=rigs())
def test_any_rig_is_mel(rig: BlendshapeRig, tmp_path: Path) -> None:
    save_rig(rig, tmp_path / "rig.ma")
    scene = MayaScene.read(tmp_path / "rig.ma")
    assert len(scene.aliases()) == len(rig.names)
    weights = torch.rand(1, len(rig.names), generator=torch.Generator().manual_seed(1))
    shown = 10 * scene.face(weights[0].tolist().__getitem__)
    assert np.abs(shown - rig(weights)[0].detach().numpy()).max() < 1e-3


def test_what_maya_cannot_hold_is_refused_or_said(tmp_path: Path) -> None:
    rig = corrective_sheet()
    assert any("1 peaks are rounded" in line for line in maya_notes(rig))
    close = (Corrective("one", ("jawOpen",), 0.5), Corrective("other", ("jawOpen",), 0.5002))
    twice = BlendshapeRig(rig.neutral, rig.deltas, rig.names, Correctives(rig.correctives.deltas[:2], close))
    with pytest.raises(FileFormatError, match=r"two samples of 'jawOpen' within a thousandth of 0\.5"):
        save_rig(twice, tmp_path / "rig.ma")
    assert not list(tmp_path.iterdir())
    maps = DetailMaps(("jawOpen",), torch.zeros(1, 3, 4, 4), None)
    with pytest.raises(FileFormatError, match=r"detail maps for a \.ma file"):
        save_rig(rig, tmp_path / "rig.ma", maps)


def test_a_whole_head_has_short_commands(tmp_path: Path) -> None:
    save_rig(performer(texture=False), tmp_path / "rig.ma")
    found = statements((tmp_path / "rig.ma").read_text())
    mesh = [words for words in found if len(words) > 3 and words[3][1].startswith(".vt[")]
    assert len(mesh) == 13
    assert max(len(words) for words in mesh) < 1600
