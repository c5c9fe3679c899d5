"""Charts of several tiles come into one image, where none covers another, and keep their form."""

import torch
from torch import Tensor

from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.geometry.meshes.uv_tiles import in_one_tile


def squares(places: list[tuple[float, float]]) -> tuple[Tensor, Tensor]:
    """Two triangles each, a square of 0.8 in the texture at a place."""
    corner = torch.tensor([[0.0, 0.0], [0.8, 0.0], [0.8, 0.8], [0.0, 0.8]])
    uvs = torch.cat([corner + torch.tensor(place) + 0.1 for place in places])
    return uvs, torch.cat([torch.tensor([[0, 1, 2], [0, 2, 3]]) + 4 * number for number in range(len(places))])


def test_each_tile_and_each_kind_has_a_square_of_its_own() -> None:
    kind = torch.tensor([0, 1, 0, 2, 0]).repeat_interleave(2)
    uvs, rows = in_one_tile(*squares([(0, 0), (0, 0), (3, 0), (1, 0), (0, 1)]), kind)
    assert 0 <= float(uvs.min()) <= float(uvs.max()) <= 1
    covered = torch.stack([rasterise_uvs(uvs, rows[2 * k : 2 * k + 2], 256, 256).mask().long() for k in range(5)])
    assert int(covered.sum(0).max()) == 1  # no texel is of two charts
    corners = uvs[rows].reshape(5, 6, 2)
    extent = corners.amax(1) - corners.amin(1)
    torch.testing.assert_close(extent[:, 0], extent[:, 1])  # squares stay squares


def test_one_tile_stays_as_it_is() -> None:
    uvs, rows = squares([(0, 0), (0, 0)])
    assert in_one_tile(uvs, rows, torch.tensor([0, 0, 1, 1])) == (uvs, rows)
