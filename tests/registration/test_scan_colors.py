"""A scan's colours on the template, where every point's colour is known."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.mesh import Mesh
from torchface.registration import register, with_template_skin
from torchface.registration.scan_colors import (
    ScanColors,
    in_shade,
    own_colors,
    resampled_texture,
    skin_base,
    with_edge_of_hair,
)
from torchface.synthetic import performer


def paint(points: Tensor) -> Tensor:
    """Smooth colours by position on the mask."""
    x, y, z = points.unbind(-1)
    return torch.stack([0.5 + x / 200, 0.5 + y / 280, 0.5 + 0.3 * torch.sin(z / 30)], dim=-1).clamp(0, 1).float()


def painted_texture(mesh: Mesh, height: int, width: int) -> Tensor:
    texels = rasterise_uvs(mesh.uvs, mesh.uv_faces, height, width)
    image = torch.zeros(3, height * width)
    image[:, texels.texels] = paint(texels.interpolate(mesh.vertices, mesh.faces)).T
    return image.reshape(3, height, width)


def given(template: Mesh) -> tuple[Tensor, Tensor]:
    return template.landmarks, template.vertices[template.landmarks]


@pytest.fixture(scope="module")
def finer(make_mask) -> Mesh:
    """The scan: the same surface at another resolution, its texture turned by a quarter against the template's."""
    mesh = make_mask(61, 83)
    return replace(mesh, uvs=torch.stack([mesh.uvs[:, 1], 1 - mesh.uvs[:, 0]], dim=-1), annotations=None)


@pytest.fixture(scope="module")
def textured(finer: Mesh) -> Mesh:
    return replace(finer, texture=painted_texture(finer, 200, 300))


def check_colors(result: Mesh, matched: Tensor) -> None:
    wrong = (result.colors - paint(result.vertices)).abs().amax(1)
    assert float(wrong[matched].quantile(0.95)) < 0.02
    assert float(wrong.mean()) < 0.02


def check_texture(result: Mesh, size: int) -> None:
    assert result.texture.shape == (3, size, size)
    texels = rasterise_uvs(result.uvs, result.uv_faces, size, size)
    expected = paint(texels.interpolate(result.vertices, result.faces))
    wrong = (result.texture.reshape(3, -1)[:, texels.texels].T - expected).abs().amax(1)
    assert float(wrong.quantile(0.95)) < 0.02


def test_a_textured_scans_colours_come_over(mask: Mesh, textured: Mesh) -> None:
    result = register(mask, textured, given(mask), texture_size=128)
    check_colors(result.mesh, result.matched)
    check_texture(result.mesh, 128)
    assert torch.equal(result.mesh.uvs, mask.uvs)


def test_an_inside_out_scans_colours_come_over_alike(mask: Mesh, textured: Mesh) -> None:
    turned = replace(textured, faces=textured.faces.flip(1), uv_faces=textured.uv_faces.flip(1))
    result = register(mask, turned, given(mask), texture_size=128)
    check_colors(result.mesh, result.matched)
    check_texture(result.mesh, 128)


def test_vertex_colours_serve_where_there_is_no_texture(mask: Mesh, finer: Mesh) -> None:
    result = register(mask, replace(finer, colors=paint(finer.vertices)), given(mask), texture_size=64)
    check_colors(result.mesh, result.matched)
    check_texture(result.mesh, 64)


def test_a_texture_that_no_coordinates_reach_is_told(mask: Mesh, textured: Mesh) -> None:
    result = register(mask, replace(textured, uvs=None, uv_faces=None), given(mask))
    assert result.mesh.colors is None
    assert result.mesh.texture is None
    assert any("neither a texture with coordinates nor vertex colours" in note for note in result.record.notes)


def test_a_template_without_coordinates_gets_vertex_colours_and_a_note(mask: Mesh, textured: Mesh) -> None:
    result = register(replace(mask, uvs=None, uv_faces=None), textured, given(mask))
    check_colors(result.mesh, result.matched)
    assert result.mesh.texture is None
    assert any("no texture coordinates" in note for note in result.record.notes)


def test_a_texture_of_size_zero_is_none(mask: Mesh, textured: Mesh) -> None:
    result = register(mask, textured, given(mask), texture_size=0)
    assert result.mesh.texture is None
    assert result.mesh.colors is not None


def test_a_texture_of_one_texel_colours_everything_alike(mask: Mesh, finer: Mesh) -> None:
    one = replace(finer, texture=torch.tensor([0.2, 0.4, 0.6]).reshape(3, 1, 1))
    result = register(mask, one, given(mask), texture_size=32)
    assert torch.allclose(result.mesh.colors, torch.tensor([0.2, 0.4, 0.6]).expand(len(mask.vertices), 3))
    assert torch.allclose(result.mesh.texture.amin((1, 2)), result.mesh.texture.amax((1, 2)))


def test_hair_beside_what_is_unseen_is_not_shown_and_a_mole_is(mask: Mesh) -> None:
    height = mask.vertices[:, 1]
    colors = torch.full((len(height), 3), 0.6)
    unseen, strands = height > height.max() - 20, height > height.max() - 28
    colors[strands] = 0.05
    mole = int((mask.vertices[:, :2] - torch.tensor([10.0, -30.0])).norm(dim=1).argmin())
    colors[mole] = 0.05
    covered = with_edge_of_hair(unseen, colors, ~unseen, mask.faces)
    assert bool(covered[strands].all())
    assert not bool(covered[mole])
    assert not bool(covered[height < height.max() - 60].any())
    bare = torch.full_like(colors, 0.6)
    assert torch.equal(with_edge_of_hair(unseen, bare, ~unseen, mask.faces), unseen)  # a hole in the scan


def test_nostrils_that_no_scan_shows_are_dark_inside() -> None:
    head = performer(texture=False).neutral
    colors, nothing = torch.full((len(head.vertices), 3), 0.6), torch.zeros(len(head.vertices), dtype=torch.bool)
    shaded = in_shade(colors, head, nothing)
    nostrils, nose = (head.regions[name] for name in ("nostrils", "nose"))
    assert float(shaded[nostrils].mean()) < 0.3
    tip = nose & (head.vertices[:, 2] > head.vertices[nose, 2].max() - 5)
    assert torch.equal(shaded[tip], colors[tip])
    assert torch.equal(in_shade(colors, head, ~nothing), colors)  # what a scan shows


def test_what_is_unseen_has_the_templates_texture_in_the_tone_of_the_skin_alone(mask: Mesh) -> None:
    count = len(mask.vertices)
    part = torch.tensor([[0.0, 0, -400], [10, 0, -400], [0, 10, -400]]).to(mask.vertices)
    whole = Mesh(torch.cat([mask.vertices, part]), torch.cat([mask.faces, count + torch.tensor([[0, 1, 2]])]))
    place = torch.cat([mask.vertices[:, 1] > 0, torch.tensor([False] * 3)])
    uvs = torch.where(place[:, None], torch.tensor([0.75, 0.5]), torch.tensor([0.25, 0.5]))
    texture = torch.full((3, 8, 8), 0.4)
    texture[:, :, 4:] = 0.1  # hair
    template = replace(whole, uvs=uvs, uv_faces=whole.faces, texture=texture)
    colors = torch.full((count + 3, 3), 0.6)
    colors[count:] = 0.01  # a black shirt
    seen = ~place
    base = skin_base(colors, template, seen)
    assert float((base[:count][~place[:count]] - 0.6).abs().max()) < 0.01
    assert float((base[place] - 0.15).abs().max()) < 0.01


def test_what_is_unseen_has_what_the_templates_texture_shows_between_vertices(mask: Mesh, textured: Mesh) -> None:
    """From vertices alone a hairline came out as a blurred block of sideburn."""
    stripes = 0.4 + 0.2 * (torch.arange(256) // 4 % 2).float().expand(3, 256, 256)
    template = replace(mask, texture=stripes)
    source = ScanColors(textured, textured.vertices.double(), textured.faces, torch.arange(len(textured.faces)))
    darker = 0.5 * own_colors(template)
    made = resampled_texture(mask, template, darker, torch.zeros(len(mask.vertices)), source, 256)
    inside = rasterise_uvs(mask.uvs, mask.uv_faces, 256, 256).texels
    torch.testing.assert_close(made.flatten(1)[:, inside], 0.5 * stripes.flatten(1)[:, inside], rtol=0, atol=0.02)


def test_a_templates_texture_reaches_a_seam_beyond_the_hidden_part_to_all_sides() -> None:
    corners = torch.tensor([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    square = Mesh(
        torch.nn.functional.pad(corners, (0, 1)), faces, uvs=corners, uv_faces=faces, texture=torch.zeros(3, 32, 32)
    )
    white = replace(square, texture=torch.ones(3, 32, 32))
    taken = with_template_skin(square, white, torch.ones(4, dtype=torch.bool)).texture[0].nonzero()
    assert taken.amin(0).tolist() == [4, 4]
    assert taken.amax(0).tolist() == [27, 27]
    assert len(taken) == 24 * 24
