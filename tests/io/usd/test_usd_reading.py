"""Scenes as other programs write them: units, axes, transforms, instances, hidden prims, layers, skins."""

from pathlib import Path

import pytest
import torch

from torchface.correctives import Corrective
from torchface.io import load_animation, load_mesh, load_rig, save_image, save_rig

pytestmark = pytest.mark.usefixtures("same_process")

QUAD = """
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
"""
SHAPES = """
    uniform token[] skel:blendShapes = ["open", "wide"]
    rel skel:blendShapeTargets = [<open>, <wide>]
    rel skel:skeleton = </head/skeleton>
    def BlendShape "open"
    {
        uniform vector3f[] offsets = [(0, 0, 1)]
        uniform int[] pointIndices = [2]
    }
    def BlendShape "wide"
    {
        uniform vector3f[] offsets = [(0, 0, 1), (0, 0, 2), (0, 0, 3), (0, 0, 4)]
    }
"""
ANIMATION = """
    def Skeleton "skeleton" (prepend apiSchemas = ["SkelBindingAPI"])
    {
        rel skel:animationSource = </head/moves>
    }
    def SkelAnimation "moves"
    {
        uniform token[] blendShapes = ["wide", "stranger", "open"]
        float[] blendShapeWeights.timeSamples = { 1001: [0, 9, 0], 1002: [0.5, 9, 0.25], 1003: [1, 9, 0] }
    }
"""


def usda(path: Path, body: str, head: str = 'metersPerUnit = 0.01\nupAxis = "Y"') -> Path:
    path.write_text(f"#usda 1.0\n(\n{head}\n)\n{body}\n", errors="surrogateescape")
    return path


def mesh_prim(name: str = "face", body: str = QUAD, api: str = '"SkelBindingAPI"') -> str:
    return f'def Mesh "{name}" (prepend apiSchemas = [{api}])\n{{{body}}}\n'


def head(body: str, xform: str = "") -> str:
    return f'def SkelRoot "head" (prepend apiSchemas = ["SkelBindingAPI"])\n{{\n{xform}\n{body}\n}}\n'


def test_lengths_are_by_the_files_unit_unless_told(tmp_path: Path) -> None:
    path = usda(tmp_path / "cm.usda", head(mesh_prim(body=QUAD + SHAPES)))
    rig = load_rig(path)
    assert rig.names == ("open", "wide")
    assert rig.vertices[2].tolist() == [10, 10, 0]
    assert rig.deltas[0].tolist() == [[0, 0, 0], [0, 0, 0], [0, 0, 10], [0, 0, 0]]
    assert rig.deltas[1, :, 2].tolist() == [10, 20, 30, 40]
    assert load_rig(path, unit="m").vertices[2].tolist() == [1000, 1000, 0]
    plain = usda(tmp_path / "plain.usda", mesh_prim(), head="")
    assert load_mesh(plain).vertices[2].tolist() == [10, 10, 0]  # USD's own default: centimetres, y up


def test_z_up_files_stand_upright(tmp_path: Path) -> None:
    path = usda(tmp_path / "z.usda", head(mesh_prim(body=QUAD + SHAPES)), 'metersPerUnit = 1\nupAxis = "Z"')
    rig = load_rig(path)
    assert rig.vertices[2].tolist() == [1000, 0, -1000]  # their y is away from the viewer
    assert rig.deltas[0, 2].tolist() == [0, 1000, 0]


def test_a_mesh_stands_where_its_parents_put_it(tmp_path: Path) -> None:
    moved = """
    double3 xformOp:translate = (0, 5, 0)
    float3 xformOp:scale = (2, 2, 2)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    """
    rig = load_rig(usda(tmp_path / "moved.usda", head(mesh_prim(body=QUAD + SHAPES), moved)))
    assert rig.vertices[2].tolist() == [20, 70, 0]
    assert rig.deltas[0, 2].tolist() == [0, 0, 20]


def test_a_skinned_mesh_stands_where_its_skeleton_does(tmp_path: Path) -> None:
    skin = """
    int[] primvars:skel:jointIndices = [0] (elementSize = 1
    interpolation = "constant")
    float[] primvars:skel:jointWeights = [1] (elementSize = 1
    interpolation = "constant")
    matrix4d primvars:skel:geomBindTransform = ((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,3,1))
    double3 xformOp:translate = (100, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    """
    skeleton = 'def Skeleton "skeleton"\n{\nuniform token[] joints = ["neck"]\n}\n'
    path = usda(tmp_path / "skin.usda", head(mesh_prim(body=QUAD + SHAPES + skin) + skeleton))
    assert load_rig(path).vertices[2].tolist() == [10, 10, 30]


def test_left_handed_faces_turn_round(tmp_path: Path) -> None:
    uvs = 'texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "faceVarying")\n'
    left = QUAD + uvs + 'uniform token orientation = "leftHanded"\n'
    mesh = load_mesh(usda(tmp_path / "left.usda", mesh_prim(body=left)))
    assert mesh.polygons.tolist() == [[0, 3, 2, 1]]
    assert torch.equal(mesh.uvs[mesh.uv_faces][0], mesh.vertices[mesh.faces][0, :, :2] / 10)


def test_several_meshes_are_one_rig_with_a_region_each(tmp_path: Path) -> None:
    hidden = mesh_prim("hidden", QUAD + 'token visibility = "invisible"\n')
    guide = mesh_prim("guide", QUAD + 'uniform token purpose = "guide"\n')
    both = mesh_prim("skin", QUAD + SHAPES) + mesh_prim("teeth") + hidden + guide
    rig = load_rig(usda(tmp_path / "two.usda", head(both + ANIMATION)))
    assert len(rig.vertices) == 8
    assert list(rig.neutral.annotations.regions) == ["skin", "teeth"]
    assert rig.deltas[:, 4:].abs().max() == 0


def test_an_animation_from_frame_1001_is_one_from_its_start(tmp_path: Path) -> None:
    first = 'metersPerUnit = 0.01\nupAxis = "Y"\ntimeCodesPerSecond = 25\nstartTimeCode = 1001\nendTimeCode = 1003'
    text = head(mesh_prim(body=QUAD + SHAPES) + ANIMATION)
    take = load_animation(usda(tmp_path / "take.usda", text, first))
    before = load_animation(
        usda(tmp_path / "before.usda", text.replace('prepend apiSchemas = ["SkelBindingAPI"]', ""), first)
    )
    assert torch.equal(before.weights.values, take.weights.values)  # files from before USD 23.8 apply no schema
    assert take.fps == 25
    assert take.weights.names == ("wide", "open")  # what is no shape of a mesh is left out
    assert take.weights.values[..., 0].tolist() == [[0, 0], [0.5, 0.25], [1, 0]]
    assert take.seconds is None


def test_in_betweens_of_other_programs_are_correctives(tmp_path: Path) -> None:
    half = "uniform vector3f[] inbetweens:half = [(0, 1, 1)] (weight = 0.5)\nuniform int[] pointIndices = [2]"
    shapes = SHAPES.replace("uniform int[] pointIndices = [2]", half)
    rig = load_rig(
        usda(tmp_path / "half.usda", head(mesh_prim(body=QUAD + shapes) + mesh_prim("lashes", QUAD + shapes)))
    )
    assert rig.names == ("open", "wide")
    assert rig.correctives.definitions == (Corrective("half", ("open",), 0.5),)
    moved = rig(torch.tensor([[0.5, 0.0], [0.25, 0.0], [0.75, 0.0], [1.0, 0.0]])) - rig.vertices
    expected = [[0, 10, 10], [0, 5, 5], [0, 5, 10], [0, 0, 10]]  # straight lines between the samples
    assert moved[:, 2].tolist() == moved[:, 6].tolist() == expected
    assert moved[:, [0, 1, 3]].abs().max() == 0


def test_layers_beside_the_file_are_composed(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    usda(tmp_path / "parts" / "face.usda", head(mesh_prim(body=QUAD + SHAPES)), 'defaultPrim = "head"')
    over = 'over "face"\n{\npoint3f[] points = [(0, 0, 0), (1, 0, 0), (1, 3, 0), (0, 1, 0)]\n}\n'
    body = f'def "head" (references = @./parts/face.usda@)\n{{\n{over}\n}}\n'
    rig = load_rig(usda(tmp_path / "shot.usda", body))
    assert rig.vertices[2].tolist() == [10, 30, 0]
    assert rig.names == ("open", "wide")


def material(name: str, image: str) -> str:
    """A material with a texture, and what binds it."""
    return f"""def Material "{name}"
{{
token outputs:surface.connect = </{name}/surface.outputs:surface>
def Shader "surface"
{{
uniform token info:id = "UsdPreviewSurface"
color3f inputs:diffuseColor.connect = </{name}/texture.outputs:rgb>
token outputs:surface
}}
def Shader "texture"
{{
uniform token info:id = "UsdUVTexture"
asset inputs:file = @./{image}@
float3 outputs:rgb
}}
}}
"""


def painted(name: str, by: str) -> str:
    return mesh_prim(name, QUAD + f"rel material:binding = </{by}>\n", '"MaterialBindingAPI"')


def test_a_tiled_texture_is_told_and_the_mesh_read(tmp_path: Path) -> None:
    path = usda(tmp_path / "tiles.usda", painted("face", "skin") + material("skin", "skin.<UDIM>.png"))
    with pytest.warns(UserWarning, match=r"tiles\.usda: left out: the tiled texture \(UDIM\) \./skin\.<UDIM>\.png"):
        mesh = load_mesh(path)
    assert mesh.texture is None


def test_each_face_shows_its_own_material(tmp_path: Path) -> None:
    for name, value in (("skin.png", 0.2), ("teeth.png", 0.8)):
        save_image(torch.full((3, 2, 2), value), tmp_path / name)
    subset = """def GeomSubset "gums" (prepend apiSchemas = ["MaterialBindingAPI"])
{
uniform token elementType = "face"
uniform token familyName = "materialBind"
int[] indices = [1]
rel material:binding = </gums>
}
"""
    pair = QUAD.replace("[4]", "[3, 3]").replace("[0, 1, 2, 3]", "[0, 1, 2, 0, 2, 3]")
    mouth = mesh_prim("mouth", pair + "rel material:binding = </teeth>\n" + subset, '"MaterialBindingAPI"')
    gums = material("gums", "skin.png").replace(".connect = </gums/texture.outputs:rgb>", " = (1, 0, 0)")
    body = painted("face", "skin") + mouth + material("skin", "skin.png") + material("teeth", "teeth.png") + gums
    mesh = load_mesh(usda(tmp_path / "three.usda", body))
    middle = mesh.uvs[mesh.uv_faces].mean(1)
    size = torch.tensor([mesh.texture.shape[2], mesh.texture.shape[1]])
    at = (torch.stack([middle[:, 0], 1 - middle[:, 1]], 1) * size).long()
    seen = mesh.texture[:, at[:, 1], at[:, 0]].T
    grey = [[0.2] * 3, [0.2] * 3, [0.8] * 3, [1.0, 0.0, 0.0]]
    torch.testing.assert_close(seen, torch.tensor(grey), atol=1 / 255, rtol=0)
    assert mesh.polygons.tolist() == [[0, 1, 2, 3], [4, 5, 6, -1], [4, 6, 7, -1]]  # quads stay where meshes are joined


@pytest.mark.real
def test_a_real_head_comes_back_through_glb_and_usdc_vertex_by_vertex(ict_folder: Path, tmp_path: Path) -> None:
    rig = load_rig(ict_folder, part="face", shapes=("jawOpen", "mouthSmile_R"))
    save_rig(rig, tmp_path / "head.glb")
    save_rig(load_rig(tmp_path / "head.glb"), tmp_path / "head.usdc")
    found = load_rig(tmp_path / "head.usdc")
    assert found.names == rig.names
    assert (found.vertices - rig.vertices).abs().max() <= 1e-4
    assert (found.deltas - rig.deltas).abs().max() <= 1e-4
    assert (found.neutral.polygons == rig.neutral.polygons).all()
    corners, expected = found.neutral.uvs[found.neutral.uv_faces], rig.neutral.uvs[rig.neutral.uv_faces]
    assert (corners - expected).abs().max() <= 1e-6  # glTF counts v from the top
    assert list(found.neutral.annotations.regions) == list(rig.neutral.annotations.regions)
    assert (tmp_path / "head.usdc").stat().st_size < 1.1 * (tmp_path / "head.glb").stat().st_size
