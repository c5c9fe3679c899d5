"""Parts that a texture does not cover are drawn in colours of their own."""

from dataclasses import replace

import pytest
import torch

from torchface.mesh import Annotations, Mesh
from torchface.part_materials import EYEBALL
from torchface.rendering.part_colors import region_colors
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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_edges_of_an_eyes_iris_and_pupil_are_soft(dtype: torch.dtype) -> None:
    angle = torch.deg2rad(torch.arange(0.0, 360.0, dtype=dtype))
    ring = torch.stack([angle.sin(), torch.zeros_like(angle), angle.cos()], dim=1)
    ball = torch.cat([ring, ring[:, [1, 0, 2]], torch.zeros_like(ring[:1])])  # great circles across, and the middle
    everything = {"eyeball_left": torch.ones(len(ball), dtype=torch.bool)}
    colors = region_colors(Mesh(12 * ball, torch.tensor([[0, 1, 2]]), annotations=Annotations(None, everything)))
    assert float(colors[:60].diff(dim=0).abs().max()) < 0.2  # a hard edge: 0.67
    assert float(colors[0].max()) < 0.1 < 0.8 < float(colors[60].min())
    assert torch.equal(colors[-1], colors[180])  # no way leads from the middle to the middle
