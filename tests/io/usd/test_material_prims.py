"""Wrinkle maps in USD, there and back, and those of other programs."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rig_samples import sheet_rig

from torchface.errors import FileFormatError, NameMismatchError, TopologyError
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.io import load_detail_maps, load_rig, save_rig
from torchface.rig import BlendshapeRig

pytestmark = pytest.mark.usefixtures("same_process")
STEP = 2 / 255  # of 8 bits from -1 to 1, with what norming adds


def some_maps(*shape: int) -> torch.Tensor:
    vectors = 0.4 * torch.randn(*shape, generator=torch.Generator().manual_seed(0))
    vectors.select(-3, 2).abs_().add_(0.5)
    return torch.nn.functional.normalize(vectors, dim=-3)


def detail(neutral: bool = True) -> DetailMaps:
    names = (sheet_rig().names[1], sheet_rig().names[0])
    return DetailMaps(names, some_maps(2, 3, 8, 12), some_maps(3, 8, 12) if neutral else None)


@pytest.mark.parametrize("ending", [".usda", ".usdc", ".usdz"])
@pytest.mark.parametrize("neutral", [True, False])
def test_maps_come_back_and_the_rig_with_them(ending: str, neutral: bool, tmp_path: Path) -> None:
    rig, given = sheet_rig(), detail(neutral)
    save_rig(rig, tmp_path / f"rig{ending}", given)
    found = load_detail_maps(tmp_path / f"rig{ending}")
    assert found.names == given.names
    assert (found.maps - given.maps).abs().max() < STEP
    assert (found.neutral is not None) == neutral
    if neutral:
        assert (found.neutral - given.neutral).abs().max() < STEP
    back = load_rig(tmp_path / f"rig{ending}")
    assert back.names == rig.names
    assert (back.neutral.texture - rig.neutral.texture).abs().max() < 1 / 255  # none of the maps
    if ending == ".usdz":
        assert [file.name for file in tmp_path.iterdir()] == ["rig.usdz"]


def test_usds_own_checks_find_nothing_and_renderers_see_the_neutral(tmp_path: Path) -> None:
    from pxr import Usd, UsdShade, UsdValidation

    save_rig(sheet_rig(), tmp_path / "rig.usdz", detail())
    stage = Usd.Stage.Open(str(tmp_path / "rig.usdz"))
    checks = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert [str(error.GetMessage()) for error in UsdValidation.ValidationContext(checks).Validate(stage)] == []
    surfaces = [UsdShade.Shader(prim) for prim in stage.Traverse() if prim.GetName() == "surface"]
    sources = [shader.GetInput("normal").GetConnectedSources()[0] for shader in surfaces if shader.GetInput("normal")]
    assert [source[0].source.GetPrim().GetName() for source in sources] == ["neutral_normals"]


def test_a_file_without_maps_has_none(tmp_path: Path) -> None:
    save_rig(sheet_rig(), tmp_path / "rig.usdc")
    assert load_detail_maps(tmp_path / "rig.usdc") is None


def test_what_does_not_fit_is_named(tmp_path: Path) -> None:
    rig = sheet_rig()
    with pytest.raises(NameMismatchError, match="the rig has no shape 'frown'"):
        save_rig(rig, tmp_path / "rig.usdc", DetailMaps(("frown",), some_maps(1, 3, 4, 4)))
    bare = BlendshapeRig(replace(rig.neutral, uvs=None, uv_faces=None, texture=None), rig.deltas, rig.names)
    with pytest.raises(TopologyError, match="mesh without texture coordinates"):
        save_rig(bare, tmp_path / "rig.usdc", detail())
    save_rig(rig, tmp_path / "rig.usda", detail())
    text = (tmp_path / "rig.usda").read_text()
    (tmp_path / "rig.usda").write_text(text.replace('def Shader "wrinkles_1"', 'def Shader "gone"'))
    with pytest.raises(FileFormatError, match="no texture wrinkles_1, expected one for each detail map noted"):
        load_detail_maps(tmp_path / "rig.usda")
    (tmp_path / "rig.usda").write_text(text.replace("rig_wrinkles_1.png", "rig.png"))
    with pytest.raises(FileFormatError, match="found detail maps of 12x8 and 8x4 pixels, expected one size"):
        load_detail_maps(tmp_path / "rig.usda")


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        ("wrinkles_0", "../surface", "no texture"),
        ("mouthSmileLeft", "jawOpen", "names more than once"),
    ],
)
def test_notes_that_somebody_changed_are_refused(before: str, after: str, told: str, tmp_path: Path) -> None:
    save_rig(sheet_rig(), tmp_path / "rig.usda", detail())
    head, key, notes = (tmp_path / "rig.usda").read_text().partition("wrinkleMaps")
    line, rest = notes.split("\n", 1)
    assert before in line
    (tmp_path / "rig.usda").write_text(head + key + line.replace(before, after) + "\n" + rest)
    with pytest.raises(FileFormatError, match=told):
        load_detail_maps(tmp_path / "rig.usda")
