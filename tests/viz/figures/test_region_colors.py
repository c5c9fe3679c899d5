"""Parts that a texture does not cover are drawn in colours of their own."""

from dataclasses import replace

import torch

from torchface.mesh import Annotations, Mesh
from torchface.part_materials import EYEBALL
from torchface.synthetic import performer
from torchface.viz.figures.region_colors import as_seen


def three_sheets() -> Mesh:
    """Skin in the first tile, an eyeball and lashes in further ones; vertex colours are the skin's everywhere."""
    square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    vertices = torch.cat([square + torch.tensor([2.0 * i, 0, 0]) for i in range(3)])
    faces = torch.cat([torch.tensor([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(3)])
    uvs = torch.cat([0.5 * square[:, :2] + torch.tensor([1.25 * i, 0]) for i in range(3)])
    part = torch.arange(12) // 4
    regions = {"face": part == 0, "eyeball_left": part == 1, "eyelashes_left": part == 2}
    return Mesh(
        vertices,
        faces,
        uvs,
        faces,
        colors=torch.full((12, 3), 0.5),
        texture=torch.full((3, 4, 4), 0.7),
        annotations=Annotations(None, regions),
    )


def test_an_eye_in_a_further_tile_is_an_eye_and_lashes_do_not_hide_it() -> None:
    mesh = three_sheets()
    seen = as_seen(mesh)
    assert torch.equal(seen.colors[:4], mesh.colors[:4])
    torch.testing.assert_close(seen.colors[4:8], torch.tensor(EYEBALL.color).expand(4, 3))
    assert seen.faces.tolist() == mesh.faces[:4].tolist()
    assert len(seen.uv_faces) == 4


def test_eyes_with_texels_of_their_own_keep_them() -> None:
    textured = performer(texture=True).neutral
    assert as_seen(textured) is textured
    mesh = three_sheets()
    inside = replace(mesh, uvs=0.3 * mesh.uvs)
    assert as_seen(inside) is inside
