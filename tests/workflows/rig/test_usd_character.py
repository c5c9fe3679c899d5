"""A USD character gets blend shapes on its face; everything else of its layer stays."""

from pathlib import Path

import pytest
import torch
from reading_here import same_process  # noqa: F401

from planted.characters import box_mesh
from torchface.io.gltf.character_annotations import annotate_character
from torchface.io.gltf.character_scene import read_character
from torchface.io.usd.usd_reading import read_usd_rig
from torchface.mesh import Annotations
from torchface.synthetic import performer
from torchface.workflows.rig import usd_character
from torchface.workflows.rig.character_rig import CharacterReport
from torchface.workflows.rig.usd_character import rig_usd_character


def write_stage(path: Path) -> None:
    """A head in centimetres, z up, with a shape of its own, beside a box with a material."""
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetDefaultPrim(UsdSkel.Root.Define(stage, "/Root").GetPrim())
    rig = performer(texture=False)
    material = UsdShade.Material.Define(stage, "/Root/Cloth")
    for name, vertices, faces in (
        ("Head", rig.vertices, rig.neutral.faces),
        ("Box", *box_mesh(torch.tensor([0.0, -400, 0]), torch.tensor([300.0, 300, 200]))),
    ):
        mesh = UsdGeom.Mesh.Define(stage, f"/Root/{name}")
        turned = vertices.double()[:, [0, 2, 1]] * torch.tensor([0.1, -0.1, 0.1])
        mesh.CreatePointsAttr([Gf.Vec3f(*row) for row in turned.tolist()])
        mesh.CreateFaceVertexCountsAttr([3] * len(faces))
        mesh.CreateFaceVertexIndicesAttr(faces.flatten().tolist())
        mesh.GetPrim().SetCustomDataByKey("studio", {"shot": 7})
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    head = stage.GetPrimAtPath("/Root/Head")
    own = UsdSkel.BlendShape.Define(stage, "/Root/Head/jawOpen")
    own.CreateOffsetsAttr([Gf.Vec3f(0, 0, -1)])
    own.CreatePointIndicesAttr([5])
    binding = UsdSkel.BindingAPI.Apply(head)
    binding.CreateBlendShapesAttr(["jawOpen"])
    binding.CreateBlendShapeTargetsRel().SetTargets([Sdf.Path("/Root/Head/jawOpen")])
    stage.GetRootLayer().Save()


@pytest.mark.usefixtures("same_process")
@pytest.mark.parametrize("ending", [".usda", ".usdc", ".usdz"])
def test_shapes_are_added_in_the_files_axes_and_the_rest_stays(
    ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pxr import Sdf, UsdUtils

    path, out = tmp_path / f"a{ending}", tmp_path / f"b{ending}"
    plain = tmp_path / ("a.usdc" if ending == ".usdz" else path.name)
    write_stage(plain)
    if ending == ".usdz":
        assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(plain)), str(path))
    smile = performer(texture=False).select(["mouthSmileLeft"])

    def rigged(bare: Path, made: Path, progress: object = None) -> CharacterReport:
        """Stands in for the search and the registration: the known shape on the first mesh."""
        from torchface.io.gltf.gltf_document import read_document
        from torchface.io.gltf.morph_insertion import AddedTargets, document_with_targets, write_edited

        document = read_document(bare)
        added = AddedTargets(0, (0,), (smile.deltas / 1000).numpy())
        root, data = document_with_targets(document, [added], smile.names)
        marks = Annotations(smile.neutral.landmarks, {"lids": smile.neutral.annotations.regions["lids_left"]})
        annotate_character(root, read_character(document), torch.arange(len(smile.vertices)), marks)
        write_edited(document, root, data, made)
        return CharacterReport(smile.names, {"jawOpen": ("jawOpen",)}, (), 0.0, (0.0, 0.0), None)

    monkeypatch.setattr(usd_character, "rig_character", rigged)
    report = rig_usd_character(path, out)
    assert report.made == ("mouthSmileLeft",)
    rig = read_usd_rig(out)
    assert rig.names == ("jawOpen", "mouthSmileLeft")
    assert torch.equal(rig.neutral.landmarks, smile.neutral.landmarks)
    assert set(rig.neutral.annotations.regions) == {"Head", "Box", "lids"}
    count = len(smile.vertices)
    assert torch.allclose(rig.deltas[1, :count], smile.deltas[0], atol=1e-3)
    assert float(rig.deltas[1, count:].abs().max()) == 0
    assert torch.equal(rig.vertices, read_usd_rig(path).vertices)
    if ending == ".usda":
        kept = {line for line in out.read_text().splitlines() if line.strip()}
        changed = ("blendShape", "apiSchemas", "doc =", "#usda")
        assert not [
            x
            for x in path.read_text().splitlines()
            if x.strip() not in {y.strip() for y in kept} and not any(c in x for c in changed) and x.strip()
        ]
