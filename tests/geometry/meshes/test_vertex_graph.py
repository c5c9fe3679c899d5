"""Reaches over meshes of heads."""

import torch

from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.synthetic import neutral_head


def test_rounds_reach_as_far_on_a_finer_mesh() -> None:
    head = neutral_head(texture=False)
    usual = VertexGraph(head.faces, len(head.vertices), head.vertices)
    assert 0.8 < usual.finer < 1.25
    half = VertexGraph(head.faces, len(head.vertices), head.vertices / 2)  # edges half as long
    assert half.rounds(10) == torch.tensor(10 * min(4 * usual.finer, 4.0)).round()
    assert VertexGraph(head.faces, len(head.vertices)).rounds(10) == 10
