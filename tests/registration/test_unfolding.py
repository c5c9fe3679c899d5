"""Triangles turned over come back, and nothing else moves."""

from __future__ import annotations

import torch

from torchface.mesh import Mesh
from torchface.registration.unfolding import turned_over, unfolded


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
