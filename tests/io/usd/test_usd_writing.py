"""Rigs and their animations come back from USD, and OpenUSD itself moves them as they move here."""

from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from rig_samples import corrective_sheet, quad_sheet, rigs, sheet_rig, sheet_take

from torchface.errors import FileFormatError, TopologyError
from torchface.io import load_animation, load_mesh, load_rig, save_animation, save_mesh, save_rig
from torchface.mesh import Annotations, Mesh
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track

pytestmark = pytest.mark.usefixtures("same_process")
MICROMETRES = 1e-4 + 1e-5  # millimetres: moves of less are left out; and what single precision does to metres
number = count()


def same(found: torch.Tensor | None, expected: torch.Tensor | None) -> bool:
    if found is None or expected is None:
        return found is expected
    return torch.equal(found, expected)


def assert_same_mesh(found: Mesh, expected: Mesh) -> None:
    assert (found.vertices - expected.vertices).abs().max() <= 1e-4
    assert torch.equal(found.faces, expected.faces)
    if found.polygons is not None:  # triangles alone are no polygons
        assert torch.equal(found.polygons, expected.polygons[:, : found.polygons.shape[1]])
    if expected.uvs is not None:
        assert torch.equal(found.uvs, expected.uvs)
    assert same(found.uv_faces, expected.uv_faces)
    if expected.colors is not None:
        assert (found.colors - expected.colors).abs().max() <= 1e-5
    ours, theirs = found.annotations, expected.annotations
    assert (ours is None) == (theirs is None)
    if ours is not None and theirs is not None:
        assert all(same(getattr(ours, name), getattr(theirs, name)) for name in ("landmarks", "mirror", "contacts"))
        assert list(ours.regions) == list(theirs.regions)
        assert all(torch.equal(ours.regions[name], mask) for name, mask in theirs.regions.items())


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rig=rigs())
def test_any_rig_comes_back(rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / f"any_{next(number)}.usdc"
    save_rig(rig, path)
    found = load_rig(path)
    assert found.names == rig.names
    assert (found.deltas - rig.deltas).abs().max() <= MICROMETRES
    assert_same_mesh(found.neutral, rig.neutral)


@pytest.mark.parametrize("ending", [".usda", ".usd", ".usdz"])
def test_every_form_holds_the_rig_its_texture_and_its_animation(ending: str, tmp_path: Path) -> None:
    rig, path = sheet_rig(), tmp_path / f"sheet{ending}"
    match = save_animation(rig, sheet_take(), path)
    assert match.driven == ("jawOpen", "mouthSmileLeft")
    beside = [] if ending == ".usdz" else ["sheet.png"]
    assert sorted(one.name for one in tmp_path.iterdir()) == [*beside, path.name]
    found = load_rig(path)
    assert found.names == rig.names
    assert (found.deltas - rig.deltas).abs().max() <= MICROMETRES
    assert_same_mesh(found.neutral, rig.neutral)
    assert (found.neutral.texture - rig.neutral.texture).abs().max() <= 0.5 / 255 + 1e-6
    take = load_animation(path)
    assert take.fps == 60
    assert torch.equal(rig.weights_from(take.weights), rig.weights_from(sheet_take().weights))


def test_a_mesh_without_shapes_is_a_mesh_and_no_rig(tmp_path: Path) -> None:
    mesh = quad_sheet()
    save_mesh(mesh, tmp_path / "sheet.usdc")
    assert_same_mesh(load_mesh(tmp_path / "sheet.usdc"), mesh)
    assert load_animation(tmp_path / "sheet.usdc") is None
    with pytest.raises(FileFormatError, match="found no blend shape on its meshes"):
        load_rig(tmp_path / "sheet.usdc")
    with pytest.raises(TopologyError, match="no triangle"):
        save_mesh(Mesh(torch.zeros(3, 3), torch.zeros(0, 3, dtype=torch.int64)), tmp_path / "empty.usdc")


@pytest.mark.parametrize("fps", [24.0, 30000 / 1001, 120.0, 23.7])
def test_weights_and_rate_come_back(fps: float, tmp_path: Path) -> None:
    rig = sheet_rig()
    weights = torch.rand(300, len(rig.names), 1, generator=torch.Generator().manual_seed(0))
    save_animation(rig, Take(fps, weights=Track(rig.names, weights)), tmp_path / "take.usdc")
    found = load_animation(tmp_path / "take.usdc")
    assert found.fps == pytest.approx(fps, rel=1e-6)
    assert torch.equal(found.weights.values, weights)


def test_correctives_come_back_in_betweens_as_usds_own(tmp_path: Path) -> None:
    rig = corrective_sheet()
    take = Take(24.0, weights=Track(rig.names, torch.rand(4, 3, 1, generator=torch.Generator().manual_seed(2))))
    save_animation(rig, take, tmp_path / "rig.usda")
    assert "inbetweens:jaw_third = [" in (tmp_path / "rig.usda").read_text()
    found = load_rig(tmp_path / "rig.usda")
    assert found.names == rig.names
    assert found.correctives.definitions == rig.correctives.definitions
    assert (found.correctives.deltas - rig.correctives.deltas).abs().max() <= 2 * MICROMETRES
    played = load_animation(tmp_path / "rig.usda").weights
    assert played.names == rig.names  # what drives the combinations, without them
    assert torch.equal(played.values, take.weights.values)


@pytest.mark.parametrize("made", [sheet_rig, corrective_sheet])
def test_openusd_itself_moves_the_points_as_the_rig_does(made: Any, tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom, UsdSkel

    rig, take = made(), sheet_take(7)
    save_animation(rig, take, tmp_path / "take.usda")
    stage = Usd.Stage.Open(str(tmp_path / "take.usda"))
    assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetDefaultPrim()))
    (mesh,) = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    expected = rig(rig.weights_from(take.weights)) / 1000
    for frame in range(len(take)):
        points = np.array(mesh.GetPointsAttr().Get(frame))
        assert np.abs(points - expected[frame].numpy()).max() < 1e-7


def parts_rig() -> BlendshapeRig:
    """The sheet with its lower rows as teeth, so that it is of two materials."""
    rig = sheet_rig()
    notes = Annotations(regions={"teeth": torch.arange(len(rig.vertices)) < 12})
    mesh = Mesh.from_polygons(rig.vertices, rig.neutral.polygons, annotations=notes)
    return BlendshapeRig(mesh, rig.deltas, ("jaw open", "1st", "mouth.Smile_L"))


@pytest.mark.parametrize("ending", [".usda", ".usdc", ".usdz"])
@pytest.mark.parametrize("made", [corrective_sheet, parts_rig])
def test_the_checkers_of_usd_have_nothing_to_say(made: Any, ending: str, tmp_path: Path) -> None:
    from pxr import Usd, UsdValidation

    rig, path = made(), tmp_path / f"sheet{ending}"
    take = Take(25.0, weights=Track(rig.names, torch.rand(4, 3, 1)))
    save_animation(rig, take, path)
    checks = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(checks) > 20
    errors = UsdValidation.ValidationContext(checks).Validate(Usd.Stage.Open(str(path)))
    assert [error.GetMessage() for error in errors] == []


def test_eyes_that_no_texture_shows_are_painted_and_not_read_as_the_texture(tmp_path: Path) -> None:
    import trimesh
    from pxr import Usd, UsdShade

    shells = [trimesh.creation.uv_sphere(radius=radius, count=[16, 16]) for radius in (12.0, 11.0)]
    skin = trimesh.Trimesh([[50, 0, 0], [60, 0, 0], [50, 10, 0]], [[0, 1, 2]])
    whole = trimesh.util.concatenate([*shells, skin])
    vertices, faces = torch.tensor(whole.vertices).float(), torch.tensor(whole.faces).long()
    eye = torch.arange(len(vertices)) < len(vertices) - 3
    uvs = 0.5 + vertices[:, :2] / 130
    mesh = Mesh(vertices, faces, uvs, faces, annotations=Annotations(regions={"eyeball_left": eye}))
    save_mesh(mesh, tmp_path / "an eye [1].usdc")
    images = {path.name for path in tmp_path.glob("*.png")}
    assert images == {"an_eye__1__sclera.png", "an_eye__1__iris.png"}
    found = load_mesh(tmp_path / "an eye [1].usdc")
    assert_same_mesh(found, mesh)
    assert found.texture is None
    stage = Usd.Stage.Open(str(tmp_path / "an eye [1].usdc"))
    shaders = [UsdShade.Shader(prim) for prim in stage.Traverse() if prim.IsA(UsdShade.Shader)]
    named = [shader.GetInput("file").Get() for shader in shaders if shader.GetInput("file")]
    assert {Path(one.resolvedPath).name for one in named} == images


def test_parts_are_subsets_of_polygons_with_materials_of_their_own(tmp_path: Path) -> None:
    from pxr import Usd, UsdShade

    rig = parts_rig()
    save_rig(rig, tmp_path / "parts.usda")
    assert load_rig(tmp_path / "parts.usda").names == rig.names
    stage = Usd.Stage.Open(str(tmp_path / "parts.usda"))
    subsets = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/rig/face")).GetMaterialBindSubsets()
    found = {str(subset.GetPrim().GetName()): list(subset.GetIndicesAttr().Get()) for subset in subsets}
    lower = (rig.neutral.polygons < 12).all(1).nonzero()[:, 0].tolist()
    upper = (rig.neutral.polygons >= 12).any(1).nonzero()[:, 0].tolist()
    assert found == {"skin": upper, "teeth": lower}
