"""Completion of a scan by the template: shape and colours that pass over into those of the scan."""

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchface.geometry.meshes.operators import edges, triangle_areas
from torchface.geometry.similarity import similarity_transform
from torchface.optim.sparse import SparseCholesky

_LINK = 0.577  # cotangent of 60°: the weight of an edge between equilateral triangles
_FORM_FADES, _COLORS_FADE = 80.0, 40.0
_LEAST_AREA = 1e-3
_MIN_COUNT = 4


def completed_form(rest: Tensor, current: Tensor, faces: Tensor, unseen: Tensor, shown: Tensor) -> Tensor:
    r"""Vertices (V,3), the unseen ones where the template has them, bent to go on smoothly from those around.

    A similarity aligns the template with what the scan shows. The offset y from there to the registered vertices
    goes on over the unseen ones as a thin plate does, and fades with the distance, :math:`\ell` = 80 mm:

    .. math:: \min_y \int \lVert \Delta y \rVert^2 + \ell^{-4} \lVert y \rVert^2

    Args:
        unseen: whose positions the scan does not show, (V,) bool; the rest of the mesh stays.
        shown: whose positions it shows, (V,) bool: they align the template.

    Source: Botsch and Sorkine 2008 (thin plates over a mesh).
    """
    if not unseen.any() or int(shown.sum()) < _MIN_COUNT:
        return current
    aligned = similarity_transform(rest[shown][None], current[shown][None]).apply(rest)[0]
    stiffness, area = _membrane(aligned, faces)
    plate = stiffness @ sparse.diags_array(1 / area) @ stiffness + sparse.diags_array(area / _FORM_FADES**4)
    return aligned + _spread(plate, current - aligned, unseen)


def completed_colors(colors: Tensor, base: Tensor, vertices: Tensor, faces: Tensor, unseen: Tensor) -> Tensor:
    """Colours (V,3), the unseen ones going over from those around to a base within some 40 mm, as a membrane does.

    Args:
        base: what the skin looks like far from anything seen, (V,3).
    """
    if not unseen.any():
        return colors
    stiffness, area = _membrane(vertices, faces)
    system = stiffness + sparse.diags_array(area / _COLORS_FADE**2)
    return (base + _spread(system, (colors - base).double(), unseen).to(colors)).clamp(0, 1)


def _membrane(vertices: Tensor, faces: Tensor) -> tuple[sparse.csr_array, np.ndarray]:
    """The stiffness (V,V) of a membrane with equal weights on all edges, and each vertex's area (V,)."""
    count = len(vertices)
    first, second = edges(faces).numpy().T
    half = sparse.coo_array((np.full(len(first), _LINK), (first, second)), shape=(count, count)).tocsr()
    links = half + half.T
    third = triangle_areas(vertices, faces).double() / 3
    area = torch.zeros(count, dtype=torch.float64)
    for corner in range(3):
        area.index_add_(0, faces[:, corner], third)
    return (sparse.diags_array(links.sum(1)) - links).tocsr(), area.clamp(min=_LEAST_AREA).numpy()


def _spread(system: sparse.csr_array, values: Tensor, unknown: Tensor) -> Tensor:
    """Values (V,K) with the unknown rows at the least of the quadratic form, the others held."""
    held = values.masked_fill(unknown[:, None], 0.0).numpy()
    rows = unknown.nonzero()[:, 0].numpy()
    pull = system[rows] @ held
    filled = values.clone()
    filled[unknown] = torch.from_numpy(SparseCholesky(system[rows][:, rows]).solve(-pull))
    return filled
