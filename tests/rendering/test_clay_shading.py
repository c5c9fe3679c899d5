"""Colours of a picture: the texture's where it has a place for them, else the vertices'."""

from dataclasses import replace

import torch

from torchface.geometry.cameras.pinhole import look_at
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import Lighting, render

RED, GREEN = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0])


def test_charts_of_further_tiles_have_the_vertices_colours() -> None:
    corners = torch.tensor([[-10.0, -10.0, 0.0], [10.0, -10.0, 0.0], [10.0, 10.0, 0.0], [-10.0, 10.0, 0.0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    uvs = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    mesh = Mesh(corners, faces, uvs, faces, GREEN.expand(4, 3), RED[:, None, None].expand(3, 8, 8))
    camera = look_at(torch.zeros(3), 0.0, 0.0, span=30.0, width=9, height=9)

    def middle(shown: Mesh) -> torch.Tensor:
        return render(shown, camera, samples=1)[:, 4, 4]

    first, further = middle(mesh), middle(replace(mesh, uvs=uvs + torch.tensor([2.0, 0.0])))
    assert float(first[0]) > 5 * float(first[1])
    assert float(further[1]) > 5 * float(further[0])


def test_half_the_light_is_half_in_linear_light() -> None:
    corners = torch.tensor([[-20.0, -20.0, 0.0], [20.0, -20.0, 0.0], [20.0, 20.0, 0.0], [-20.0, 20.0, 0.0]])
    colors = torch.tensor([0.8, 0.5, 0.2])
    mesh = Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), colors=colors.expand(4, 3))
    camera = look_at(torch.zeros(3), 0.0, 0.0, span=30.0, width=9, height=9)
    half = Lighting(lights=(), ambient=0.5, occlusion_rays=0, gloss=0.0)
    shown = render(mesh, camera, lighting=half, samples=1)[:, 4, 4]
    # By the formula of IEC 61966-2-1, computed apart.
    expected = torch.tensor([0.5855, 0.3608, 0.1360])
    assert (shown - expected).abs().max() < 2e-3
