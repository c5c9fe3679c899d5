"""Charts of several tiles come into one image, where none covers another, and keep their form."""

from __future__ import annotations

import torch

from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.geometry.meshes.uv_tiles import in_one_tile
from torchface.mesh import Mesh


def squares(places: list[tuple[float, float]]) -> Mesh:
    """Two triangles each, a square of 0.8 in the texture at a place."""
    corner = torch.tensor([[0.0, 0.0], [0.8, 0.0], [0.8, 0.8], [0.0, 0.8]])
    uvs = torch.cat([corner + torch.tensor(place) + 0.1 for place in places])
    faces = torch.cat([torch.tensor([[0, 1, 2], [0, 2, 3]]) + 4 * number for number in range(len(places))])
    return Mesh(torch.cat([uvs, torch.arange(len(uvs))[:, None]], dim=1), faces, uvs, faces)


def test_each_tile_and_each_kind_has_a_square_of_its_own() -> None:
    mesh = squares([(0, 0), (0, 0), (3, 0), (1, 0), (0, 1)])
    kind = torch.tensor([0, 1, 0, 2, 0]).repeat_interleave(2)
    packed = in_one_tile(mesh, kind)
    assert packed.uvs is not None
    assert packed.uv_faces is not None
    assert 0 <= float(packed.uvs.min()) <= float(packed.uvs.max()) <= 1
    covered = torch.stack([_covered(packed, number) for number in range(5)])
    assert int(covered.sum(0).max()) == 1  # no texel is of two charts
    sides = packed.uvs[packed.uv_faces].reshape(5, 6, 2)
    extent = sides.amax(1) - sides.amin(1)
    torch.testing.assert_close(extent[:, 0], extent[:, 1])  # squares stay squares


def _covered(mesh: Mesh, number: int) -> torch.Tensor:
    assert mesh.uvs is not None
    assert mesh.uv_faces is not None
    return rasterise_uvs(mesh.uvs, mesh.uv_faces[2 * number : 2 * number + 2], 256, 256).mask().long()


def test_one_tile_stays_as_it_is() -> None:
    mesh = squares([(0, 0), (0, 0)])
    assert in_one_tile(mesh, torch.tensor([0, 0, 1, 1])) is mesh
