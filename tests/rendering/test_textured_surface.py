"""Materials are drawn where they are, and a ray passes what is cut out."""

import torch

from torchface.geometry.cameras.pinhole import look_at
from torchface.rendering.textured_surface import Material, TexturedSurface

RED, BLUE = torch.tensor([1.0, 0.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, 1.0, 1.0])


def test_what_is_cut_out_shows_what_lies_behind() -> None:
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = torch.cat([square + torch.tensor([0.0, 0, 0.5]), square])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    uvs = ((square[:, :2] + 1) / 2).repeat(2, 1)
    mask = torch.ones(4, 2, 2)
    mask[3, 0] = 0.0  # the upper half is clear
    surface = TexturedSurface(vertices, faces, uvs, torch.tensor([0, 0, 1, 1]), (Material(RED, mask), Material(BLUE)))
    picture = surface.draw(look_at(torch.zeros(3), 0.0, span=2.2, width=16, height=16)).picture
    upper, lower = picture[:, 4, 8], picture[:, 12, 8]
    assert float(upper[2]) > 0.7
    assert float(upper[0]) == 0
    assert float(lower[0]) > 0.7
    assert float(lower[2]) == 0
