"""Triangles turned over come back, and nothing else moves."""

import torch

from torchface.mesh import Mesh
from torchface.registration.nonrigid.unfolding import turned_over, unfolded


def test_a_vertex_flung_across_its_neighbours_comes_back(mask: Mesh, warp) -> None:
    truth = warp(mask.vertices)
    current = truth.clone()
    for vertex in (700, 701, 1100):
        current[vertex] += torch.tensor([11.0, 9.0, 0.0])
    assert turned_over(mask.vertices, current, mask.faces).any()
    found = unfolded(mask.vertices, current, mask.faces)
    assert not turned_over(mask.vertices, found, mask.faces).any()
    far = torch.cdist(mask.vertices, mask.vertices[[700, 701, 1100]]).amin(1) > 25
    assert torch.equal(found[far], truth[far])
    assert float((found - truth).norm(dim=1).max()) < 2.0


def test_what_is_not_folded_stays(mask: Mesh, warp) -> None:
    current = warp(mask.vertices)
    assert unfolded(mask.vertices, current, mask.faces) is current


def test_a_triangle_without_area_is_not_turned_over() -> None:
    """Its normal is the rounding of its corners, which another processor rounds to the other side."""
    line = torch.tensor([[10.0, 0, 0], [20, 0, 0], [40, 0, 0], [30, 9, 0]], dtype=torch.float64)
    rounded = line.clone()
    rounded[1, 1] = 4e-15
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    other = line.clone()
    other[1, 1] = -4e-15
    assert not turned_over(rounded, other, faces).any()
    bent = line.clone()
    bent[1, 1] = -3.0
    assert not turned_over(rounded, bent, faces).any()  # it had no side to leave
    assert turned_over(line * torch.tensor([1.0, -1, 1]), line, faces).tolist() == [False, True]
