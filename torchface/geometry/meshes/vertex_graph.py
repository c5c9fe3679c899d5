"""A mesh's vertices as a graph along its edges."""

import torch
from torch import Tensor

from torchface.geometry.meshes.operators import edges


class VertexGraph:
    """Which vertices are neighbours: values are blurred and filled over the mesh rather than over its layout."""

    def __init__(self, faces: Tensor, count: int) -> None:
        self.first, self.second = edges(faces).T
        degree = torch.zeros(count, dtype=torch.float64)
        one = torch.ones(len(self.first), dtype=torch.float64)
        self.degree = degree.index_add(0, self.first, one).index_add(0, self.second, one).clamp(min=1)

    def sum(self, values: Tensor, itself: bool = False) -> Tensor:
        """Of the values (V,...) of each vertex's neighbours, and of the vertex itself if asked for, (V,...)."""
        total = (values.clone() if itself else torch.zeros_like(values)).index_add_(0, self.first, values[self.second])
        return total.index_add_(0, self.second, values[self.first])

    def smoothed(self, values: Tensor, weights: Tensor, iterations: int) -> Tensor:
        """Weighted means (V,C) over ever wider surroundings; where nothing has a weight, 0."""
        top, bottom = values * weights[:, None], weights[:, None]
        for _ in range(iterations):
            both = torch.cat([top, bottom], dim=1)
            both = 0.5 * (both + self.sum(both) / self.degree[:, None])
            top, bottom = both[:, :-1], both[:, -1:]
        return top / bottom.clamp(min=1e-12)

    def least(self, values: Tensor) -> Tensor:
        """Of each vertex and its neighbours, (V,)."""
        least = values.clone()
        least.scatter_reduce_(0, self.first, values[self.second], "amin")
        return least.scatter_reduce_(0, self.second, values[self.first], "amin")
