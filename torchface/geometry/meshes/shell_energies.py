"""Energies of a displacement over a thin shell, linearised at rest: stretching and bending as sparse matrices."""

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchface.geometry.meshes.deformation import gradient_operator
from torchface.geometry.meshes.operators import corners, triangle_areas

_LEAST_SINE = 1e-3  # a triangle without height would have infinite cotangents


def stretching_energy(vertices: Tensor, faces: Tensor) -> sparse.csr_array:
    r"""The cotangent stiffness matrix, (V,V), of :math:`-\Delta`: :math:`u^\top L u = \int |\nabla u|^2`."""
    gradients = gradient_operator(vertices, faces)
    areas = triangle_areas(vertices.double().cpu(), faces.cpu()).repeat_interleave(3).numpy()
    return sparse.csr_array(gradients.T @ sparse.diags_array(areas) @ gradients)


def bending_energy(vertices: Tensor, faces: Tensor) -> sparse.csr_array:
    r"""The quadratic bending matrix Q, (V,V): :math:`u^\top Q u` stands for :math:`\int (\Delta u)^2`, the weak form
    of :math:`\Delta^2`, to within a factor between 1 and 3 by how the edges run.

    It sums over the edges :math:`e` between two triangles of areas :math:`A_0, A_1` how much the slope across the edge
    jumps there,

    .. math:: u^\top Q u = \sum_e \frac{3}{A_0 + A_1} (K_e u)^2, \qquad
        K_e u = u_0 (\cot\alpha_1 + \cot\beta_1) + u_1 (\cot\alpha_0 + \cot\beta_0)
        - u_2 (\cot\alpha_0 + \cot\alpha_1) - u_3 (\cot\beta_0 + \cot\beta_1),

    with :math:`\alpha, \beta` the angles at the edge's ends 0 and 1 in its two triangles and 2, 3 the corners opposite.
    An edge that only one triangle has, or more than two, costs nothing: the rims of eyes and mouth are free, and on a
    flat mesh every affine field is free, at the rim too.

    Source: Bergou, Wardetzky, Harmon, Zorin, Grinspun 2006, A Quadratic Bending Model for Inextensible Surfaces.
    """
    points, faces = vertices.double().cpu(), faces.cpu()
    count = len(points)
    cotangents = _cotangents(points, faces)
    # Of each triangle's three sides: its ends, the corner opposite, the cotangents at the ends.
    first, second, opposite = faces.roll(-1, 1), faces.roll(-2, 1), faces.flatten()
    at_first, at_second = cotangents.roll(-1, 1), cotangents.roll(-2, 1)
    swap = first > second
    low, high = torch.where(swap, second, first).flatten(), torch.where(swap, first, second).flatten()
    at_low = torch.where(swap, at_second, at_first).flatten()
    at_high = torch.where(swap, at_first, at_second).flatten()
    area = triangle_areas(points, faces)[:, None].expand(-1, 3).flatten()
    _, edge, uses = (low * count + high).unique(return_inverse=True, return_counts=True)
    order = edge.argsort(stable=True)
    order = order[uses[edge[order]] == 2]
    one, other = order[0::2], order[1::2]
    columns = torch.stack([low[one], high[one], opposite[one], opposite[other]], dim=1)
    entries = torch.stack(
        [
            at_high[one] + at_high[other],
            at_low[one] + at_low[other],
            -(at_low[one] + at_high[one]),
            -(at_low[other] + at_high[other]),
        ],
        dim=1,
    )
    total = area[one] + area[other]
    weight = (3 / total.clamp(min=1e-12 * float(total.max()) if len(total) else 1.0)).sqrt()
    rows = np.arange(len(one)).repeat(4)
    jumps = sparse.coo_array(
        ((entries * weight[:, None]).flatten().numpy(), (rows, columns.flatten().numpy())), shape=(len(one), count)
    ).tocsr()
    return sparse.csr_array(jumps.T @ jumps)


def _cotangents(points: Tensor, faces: Tensor) -> Tensor:
    """Of the angle at each corner, (F,3)."""
    cotangents = []
    places = corners(points, faces)
    for k in range(3):
        one, other = places[(k + 1) % 3] - places[k], places[(k + 2) % 3] - places[k]
        sine = torch.linalg.cross(one, other).norm(dim=-1)
        longest = (one.norm(dim=-1) * other.norm(dim=-1)).clamp(min=torch.finfo(points.dtype).tiny)
        cotangents.append((one * other).sum(-1) / torch.maximum(sine, _LEAST_SINE * longest))
    return torch.stack(cotangents, dim=1)
