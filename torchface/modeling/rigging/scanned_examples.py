"""A registered expression where its scan was seen, and what was expected elsewhere."""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchface.errors import ShapeError
from torchface.geometry.meshes.operators import edges
from torchface.mesh import Mesh
from torchface.optim.sparse import SparseCholesky

_DATA_WEIGHT = 10.0
_DAMPING = 0.03


def seen_example(
    found: Mesh, expected: Tensor, seen: Tensor, data_weight: float = _DATA_WEIGHT, damping: float = _DAMPING
) -> Tensor:
    r"""The expression of a scan without what the scan has not shown.

    .. math:: \min_y \; \tau \sum_{v \in seen} \lVert y_v - (x_v - e_v) \rVert^2
        + \sum_{(v, w)} \lVert y_v - y_w \rVert^2 + \varphi \sum_v \lVert y_v \rVert^2, \quad \text{result } e + y

    over the edges (v, w) of the mesh: where a scan has holes or hair, and inside the mouth, the registered mesh follows
    its neighbours in another way each time, and the examples would teach that as the person's own. There the
    offset from what was expected is interpolated from the seen vertices and damped to zero within some edges.

    Args:
        found: the registered mesh x, laid on ``expected``.
        expected: e, (V,3), the transferred rig in that expression, millimetres.
        seen: vertices that the scans show, (V,) bool.
        data_weight: :math:`\tau`.
        damping: :math:`\varphi`.

    Returns:
        vertices (V,3), in the dtype of ``expected``.

    Raises:
        ShapeError: the shapes differ.
    """
    count = len(found.vertices)
    if expected.shape != (count, 3) or seen.shape != (count,):
        raise ShapeError(
            f"seen_example: found {tuple(expected.shape)} and {tuple(seen.shape)}, expected ({count},3), ({count},)"
        )
    first, second = edges(found.faces.cpu()).numpy().T
    half = sparse.coo_array((np.ones(len(first)), (first, second)), shape=(count, count)).tocsr()
    adjacency = half + half.T
    weight = data_weight * seen.cpu().double().numpy()
    system = sparse.diags_array(weight + damping + adjacency.sum(1)) - adjacency
    offsets = (found.vertices.double() - expected.double()).cpu().numpy()
    solved = SparseCholesky(system).solve(weight[:, None] * offsets)
    return (expected.double().cpu() + torch.from_numpy(solved)).to(expected)
