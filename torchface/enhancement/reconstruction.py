"""A surface from changes of its triangles' gradients: one system, factored once for the neutral."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from torch import Tensor

from torchface.enhancement.sparse_operator import SparseOperator, solved
from torchface.geometry.meshes.deformation import gradient_operator
from torchface.geometry.meshes.operators import border_edges, triangle_areas
from torchface.optim.sparse import SparseCholesky

_BORDER = 0.05
_ANCHOR = 1e-6  # of the diagonal's mean: places each part of the mesh, and bends next to nothing


class SurfaceReconstruction:
    r"""Finds the surface whose gradients differ from a smooth surface's as they should.

    .. math:: x = \ell + A^{-1} \nabla^\top a\,(F - F_\ell), \qquad
        A = \nabla^\top a \nabla + 0.05\, B^\top B + \epsilon I

    with the neutral's gradients :math:`\nabla` and triangle areas a, and B the one-dimensional Laplacian along borders,
    whose bends stay those of the smooth surface. As the unknown is the step from :math:`\ell`, each part of the mesh
    stays in its place.

    Args:
        neutral: (V,3), millimetres.
        faces: (F,3) int64.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, section 5.5; Botsch et al. 2006.
    """

    def __init__(self, neutral: Tensor, faces: Tensor) -> None:
        rest, faces = neutral.detach().double().cpu(), faces.cpu()
        operator = gradient_operator(rest, faces)
        transposed = sparse.csr_array(
            operator.T @ sparse.diags_array(np.repeat(triangle_areas(rest, faces).numpy(), 3))
        )
        border = _border_laplacian(faces, len(rest))
        system = transposed @ operator + _BORDER * (border.T @ border)
        anchor = _ANCHOR * max(float(system.diagonal().mean()), 1e-6)
        self._divergence = SparseOperator(transposed)
        self._factor = SparseCholesky(system + anchor * sparse.eye_array(len(rest)))

    def __call__(self, low: Tensor, changes: Tensor) -> Tensor:
        """The surface.

        Args:
            low: the smooth surface, (B,V,3), millimetres.
            changes: of the triangles' gradients from the smooth surface's, (B,F,3,3); differentiable, as ``low`` is.

        Returns:
            (B,V,3).
        """
        count, triangles = changes.shape[:2]
        columns = changes.permute(1, 3, 0, 2).reshape(3 * triangles, 3 * count)
        step = solved(self._factor, self._divergence(columns))
        return low + step.view(-1, count, 3).transpose(0, 1)


def _border_laplacian(faces: Tensor, vertex_count: int) -> sparse.csr_array:
    """Each border vertex against the mean of its neighbours along the border, (V,V); other rows are empty."""
    corner, opposite = border_edges(faces).nonzero(as_tuple=True)
    begin, end = faces[corner, (opposite + 1) % 3].numpy(), faces[corner, (opposite + 2) % 3].numpy()
    links = sparse.coo_array((np.ones(len(begin)), (begin, end)), shape=(vertex_count,) * 2).tocsr()
    links = links + links.T
    degree = links.sum(axis=1)
    on_border = (degree > 0).astype(np.float64)
    mean = sparse.diags_array(on_border / np.maximum(degree, 1)) @ links
    return sparse.csr_array(sparse.diags_array(on_border) - mean)
