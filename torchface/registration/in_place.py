"""A registered face moved to where its template is."""

from __future__ import annotations

from torch import Tensor

from torchface.geometry.similarity import similarity_transform
from torchface.mesh import Mesh


def in_place_of(mesh: Mesh, template: Mesh, weights: Tensor | None = None) -> Mesh:
    """A mesh rotated and translated, without scaling, to where a template of the same topology is.

    Args:
        mesh: V vertices.
        template: V vertices.
        weights: how much each vertex counts, (V,); equal if absent.

    Example:
        >>> import torch
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> moved = in_place_of(head.with_vertices(head.vertices + 50), head)
        >>> torch.allclose(moved.vertices, head.vertices, atol=1e-3)
        True
    """
    own, other = mesh.vertices.double(), template.vertices.double()
    pose = similarity_transform(own[None], other[None], None if weights is None else weights[None], scale=False)
    return mesh.with_vertices(pose.apply(own[None])[0].to(mesh.vertices))
