from dataclasses import replace

import pytest
import torch

from torchface.io import load_detail_maps, load_mesh
from torchface.mesh import Annotations, Mesh
from torchface.synthetic import character
from torchface.viz.browser.head_mesh import TexturedHead
from torchface.viz.browser.html_lists import pick_list, shape_list
from torchface.viz.browser.single_color_parts import split_parts, triangle_texture

trimesh = pytest.importorskip("trimesh")


def painted(mesh: Mesh) -> Mesh:
    """A texture whose left half is red and right half blue, over a map that says x < 0 is left."""
    texture = torch.zeros(3, 64, 64)
    texture[0, :, :32], texture[2, :, 32:] = 1.0, 1.0
    uvs = (mesh.vertices[:, :2] - mesh.vertices[:, :2].amin(0)) / (
        mesh.vertices[:, :2].amax(0) - mesh.vertices[:, :2].amin(0)
    )
    return replace(mesh, texture=texture, uvs=uvs.contiguous(), uv_faces=mesh.faces)


def test_parts_are_the_components_and_lose_no_triangle(two_balls: Mesh) -> None:
    parts = split_parts(two_balls)
    assert [len(part.vertex_ids) for part in parts] == [2562, 162]
    rebuilt = torch.cat([part.vertex_ids[part.faces] for part in parts])
    assert sorted(rebuilt.tolist()) == sorted(two_balls.faces.tolist())


def test_parts_take_the_textures_colours(two_balls: Mesh) -> None:
    mesh = painted(two_balls)
    parts = split_parts(mesh)
    assert len(parts) == 4
    assert {tuple(round(c) for c in part.color) for part in parts} == {(1, 0, 0), (0, 0, 1)}
    for part in parts:
        middle = mesh.vertices[part.vertex_ids[part.faces]].mean(1)
        assert ((middle[:, 0] < 0) == (part.color[0] > 0.5)).all()


def test_texture_is_looked_up_with_its_first_row_on_top(two_balls: Mesh) -> None:
    mesh = painted(two_balls)
    rows = torch.linspace(1, 0, 64)[None, :, None].expand(3, 64, 64)
    height = triangle_texture(replace(mesh, texture=rows))[:, 0]
    middle = mesh.uvs[mesh.uv_faces].mean(1)[:, 1]
    assert (height - middle).abs().max() < 0.02


def test_regions_give_colours_and_clear_shells_are_left_out(two_balls: Mesh) -> None:
    nose = torch.arange(len(two_balls.vertices)) >= 2562
    eye = replace(two_balls, annotations=Annotations(regions={"eyeball_left": nose, "face": ~nose}))
    assert min(split_parts(eye)[1].color) > 0.85
    shell = replace(two_balls, annotations=Annotations(regions={"eye_occlusion_left": nose}))
    assert len(split_parts(shell)) == 1


def test_the_textured_head_is_a_glb_that_another_reader_opens(two_balls: Mesh, tmp_path) -> None:
    mesh = painted(two_balls)
    moved = mesh.vertices + torch.tensor([0.0, 5.0, 0.0])
    path = tmp_path / "head.glb"
    path.write_bytes(TexturedHead(mesh).glb(moved))
    found = trimesh.load(path, force="mesh", process=False)
    corners = torch.tensor(1000 * found.vertices[found.faces], dtype=torch.float32)
    torch.testing.assert_close(corners, moved[mesh.faces])
    pixels = found.visual.material.baseColorTexture
    assert pixels.size == (64, 64)
    uvs = torch.tensor(found.visual.uv[found.faces], dtype=torch.float32)
    torch.testing.assert_close(uvs, mesh.uvs[mesh.uv_faces])


def test_vertex_colours_come_back_from_the_textured_head(two_balls: Mesh, tmp_path) -> None:
    colors = torch.rand(len(two_balls.vertices), 3, generator=torch.Generator().manual_seed(0))
    path = tmp_path / "head.glb"
    path.write_bytes(TexturedHead(replace(two_balls, colors=colors)).glb(two_balls.vertices))
    found = load_mesh(path)
    corners = two_balls.faces[:, :1]
    torch.testing.assert_close(found.colors[found.faces[:, :1]], colors[corners], atol=1e-5, rtol=0)


def test_wrinkles_are_the_normal_texture(two_balls: Mesh, tmp_path) -> None:
    mesh = painted(two_balls)
    direction = torch.nn.functional.normalize(torch.tensor([0.3, -0.4, 1.0]), dim=0)
    path = tmp_path / "head.glb"
    path.write_bytes(TexturedHead(mesh).glb(mesh.vertices, direction[:, None, None].expand(3, 32, 32)))
    found = load_detail_maps(path)
    assert found.names == ()
    assert found.neutral.shape == (3, 32, 32)
    assert (found.neutral - direction[:, None, None]).abs().max() < 0.01  # eight bits
    path.write_bytes(TexturedHead(mesh).glb(mesh.vertices))
    assert load_detail_maps(path) is None


def test_names_from_files_cannot_become_markup() -> None:
    evil = '<img src=x onerror="alert(1)">'
    assert "<img" not in shape_list([(evil, 0.5)])
    assert "<img" not in pick_list([("markers", "1")], [evil])
    assert "0.50" in shape_list([(evil, 0.5)])


def test_small_irises_keep_their_colour_beside_a_large_head() -> None:
    head = character(size=256).rig.neutral
    eye = head.annotations.regions["eyeball_left"]
    colors = [part.color for part in split_parts(head) if eye[part.vertex_ids].all()]
    assert max(min(color) for color in colors) > 0.6  # white
    assert min(max(color) for color in colors) < 0.4  # iris or pupil
