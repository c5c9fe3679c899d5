"""Triangles cut at points of their edges: vertices keep their number, new ones lie behind as shares of them."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchface.geometry.meshes.operators import edges


@dataclass(frozen=True, eq=False)
class CutMesh:
    """A mesh of V vertices after cuts, with W ≥ V."""

    shares: sparse.csr_array  # what each vertex is of those there were, (W,V), sparse; the first V are themselves
    faces: Tensor  # (G,3)
    source: Tensor  # the triangle that each is a part of, (G,)

    @staticmethod
    def of(count: int, faces: Tensor) -> "CutMesh":
        """A mesh of ``count`` vertices that is whole."""
        return CutMesh(sparse.eye_array(count, format="csr"), faces, torch.arange(len(faces)))

    def at(self, values: Tensor) -> Tensor:
        """Values (V,D) at its vertices, (W,D) float64."""
        return torch.from_numpy(self.shares @ values.double().numpy())

    def split(self, pairs: Tensor, share: Tensor) -> "CutMesh":
        """Edges (E,2), the smaller vertex first, cut at shares (E,) of their way; their triangles fall in pieces."""
        count, faces = self.shares.shape[0], self.faces
        key, order = (pairs[:, 0] * count + pairs[:, 1]).sort()
        other = faces.roll(-1, 1)
        wanted = torch.minimum(faces, other) * count + torch.maximum(faces, other)
        place = torch.searchsorted(key, wanted).clamp(max=len(key) - 1)
        new = torch.where(key[place] == wanted, count + order[place], -1)
        number = (new >= 0).sum(1)
        # One cut: turned so that it lies on the first edge; two: so that the third edge is whole.
        first = torch.where(number == 1, (new >= 0).long().argmax(1), ((new < 0).long().argmax(1) + 1) % 3)
        turn = (torch.arange(3) + first[:, None]) % 3
        (a, b, c), (ab, bc, ca) = faces.gather(1, turn).T, new.gather(1, turn).T
        pieces, source = [faces[number == 0]], [self.source[number == 0]]
        for kind, corners in (
            (1, ((a, ab, c), (ab, b, c))),
            (2, ((ab, b, bc), (a, ab, bc), (a, bc, c))),
            (3, ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))),
        ):
            for triangle in corners:
                pieces.append(torch.stack(triangle, 1)[number == kind])
                source.append(self.source[number == kind])
        weight = torch.stack([1 - share, share], 1).double().flatten().numpy()
        row = np.repeat(np.arange(len(pairs)), 2)
        mix = sparse.csr_array((weight, (row, pairs.flatten().numpy())), shape=(len(pairs), count))
        return CutMesh(sparse.vstack([self.shares, mix @ self.shares], "csr"), torch.cat(pieces), torch.cat(source))

    def torn(self, vertices: Tensor, below: Tensor) -> "CutMesh":
        """Copies of vertices (k,), behind all, for those triangles (G,) bool that lie below."""
        count = self.shares.shape[0]
        other = torch.arange(count)
        other[vertices] = count + torch.arange(len(vertices))
        shares = sparse.vstack([self.shares, self.shares[vertices.numpy()]], "csr")
        return CutMesh(shares, torch.where(below[:, None], other[self.faces], self.faces), self.source)

    def without(self, faces: Tensor) -> "CutMesh":
        """Without triangles (G,) bool."""
        return replace(self, faces=self.faces[~faces], source=self.source[~faces])

    def edges(self, vertices: Tensor) -> Tensor:
        """Edges (E,2) whose both ends are among vertices (W,) bool."""
        return edges(self.faces[vertices[self.faces].sum(1) > 1]) if bool(vertices.any()) else torch.zeros(0, 2).long()


def strip(outer: Tensor, inner: Tensor, outer_share: Tensor, inner_share: Tensor) -> Tensor:
    """Triangles (n+m,3) between two closed loops of vertices (n,) and (m,), at rising shares of one turn from 0."""
    faces, i, j, n, m = [], 0, 0, len(outer), len(inner)
    far = torch.cat([outer_share, torch.ones(1)]).tolist(), torch.cat([inner_share, torch.ones(1)]).tolist()
    a, b = outer.tolist(), inner.tolist()
    while i < n or j < m:  # of tens of points: each step takes the nearer next one
        if j == m or (i < n and far[0][i + 1] <= far[1][j + 1]):
            faces.append((a[i], a[(i + 1) % n], b[j % m]))
            i += 1
        else:
            faces.append((a[i % n], b[(j + 1) % m], b[j]))
            j += 1
    return torch.tensor(faces)
