"""A mesh's vertices as a graph along its edges."""

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from torchface.geometry.meshes.operators import edges

_EDGE = 4.6  # millimetres: of the performer's mesh, in whose rings of vertices reaches over heads are counted
_FINEST = 4.0


class VertexGraph:
    """Which vertices are neighbours: values are blurred and filled over the mesh rather than over its layout.

    Args:
        faces: (F,3).
        count: of vertices.
        vertices: of a head, (V,3) millimetres: a round over a finer mesh is as many as reach as far.
    """

    def __init__(self, faces: Tensor, count: int, vertices: Tensor | None = None) -> None:
        self.first, self.second = edges(faces).T
        self.finer = 1.0
        if vertices is not None:
            edge = float((vertices[self.first] - vertices[self.second]).norm(dim=1).median())
            self.finer = min(max((_EDGE / max(edge, 1e-6)) ** 2, 1 / _FINEST), _FINEST)
        rows, columns = torch.cat([self.first, self.second]).numpy(), torch.cat([self.second, self.first]).numpy()
        self._beside = csr_matrix((np.ones(len(rows)), (rows, columns)), (count, count))
        self.degree = torch.from_numpy(self._beside.sum(1).A1).clamp(min=1)

    def rounds(self, iterations: int) -> int:
        """How many rounds reach as far as these on the performer's mesh."""
        return max(1, round(iterations * self.finer))

    def reached(self, starts: Tensor, through: Tensor, edges: int) -> Tensor:
        """The starts (V,) bool, and what lies up to so many of the performer's edges from them along vertices that are
        let through, (V,) bool."""
        found = starts
        for _ in range(max(1, round(edges * self.finer**0.5))):
            found = starts | (through & (self.sum(found.double()[:, None], itself=True)[:, 0] > 0))
        return found

    def sum(self, values: Tensor, itself: bool = False) -> Tensor:
        """Of the values (V,) or (V,C) of each vertex's neighbours, and of the vertex itself if asked for."""
        total = torch.from_numpy(self._beside @ values.numpy()).to(values)
        return total + values if itself else total

    def smoothed(self, values: Tensor, weights: Tensor, iterations: int) -> Tensor:
        """Weighted means (V,C) over ever wider surroundings; where nothing has a weight, 0."""
        top, bottom = values * weights[:, None], weights[:, None]
        for _ in range(self.rounds(iterations)):
            both = torch.cat([top, bottom], dim=1)
            both = 0.5 * (both + self.sum(both) / self.degree[:, None])
            top, bottom = both[:, :-1], both[:, -1:]
        return top / bottom.clamp(min=1e-12)

    def least(self, values: Tensor) -> Tensor:
        """Of each vertex and its neighbours, (V,)."""
        least = values.clone()
        least.scatter_reduce_(0, self.first, values[self.second], "amin")
        return least.scatter_reduce_(0, self.second, values[self.first], "amin")
