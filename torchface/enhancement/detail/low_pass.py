"""The smooth part of a deformation: one implicit step of diffusion over the neutral, scaled by a wavelength."""

import math

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchface.enhancement.detail.sparse_operator import solved
from torchface.errors import ShapeError
from torchface.geometry.meshes.deformation import gradient_operator
from torchface.geometry.meshes.operators import components, triangle_areas
from torchface.number_checks import checked_number
from torchface.optim.sparse import SparseCholesky

WAVELENGTH = 28.7
"""Millimetres of which half the amplitude is left: the paper's 125, an area of mm² over whole one-rings."""

_SMALL_PART = 0.1  # of the largest part's area
_LEAST_MASS = 1e-6  # of the mean one: a vertex without area keeps its own value


class LowPass:
    r"""A linear filter of displacements over a mesh, factored once.

    .. math:: (M + \tau C)\, x' = M x, \qquad \tau = (\lambda / 2 \pi)^2

    M holds the vertices' areas (a third of their triangles'), C the cotangent stiffness. A wave of length
    :math:`\lambda` keeps half of its amplitude, longer ones more. Constants stay, and so does the mean over the area;
    what is not connected does not mix. A loose part of less than a tenth of the largest one's area, such as an eye or
    teeth, is let through as it is: it turns as a whole, which a filter would shrink.

    The paper filters positions and then needs a uniform Laplacian pass against degenerate triangles; displacements
    from the neutral leave the neutral as it is, triangles and pores included.

    Args:
        wavelength: :math:`\lambda`, millimetres.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, section 4.2, equation 1 with its sign
    put right; Desbrun et al. 1999. Its :math:`A_i` are whole one-rings, so :math:`\lambda dt = 6 \tau`.
    """

    def __init__(self, neutral: Tensor, faces: Tensor, wavelength: float = WAVELENGTH) -> None:
        self.wavelength = checked_number("wavelength", wavelength, above=True, most=1e6)
        masses = vertex_areas(neutral, faces)
        operator = gradient_operator(neutral, faces)
        areas = triangle_areas(neutral.detach().double().cpu(), faces.cpu()).numpy()
        areas[small_part_triangles(neutral, faces).cpu().numpy()] = 0
        stiffness = operator.T @ sparse.diags_array(np.repeat(areas, 3)) @ operator
        self._masses = masses
        self._factor = SparseCholesky(
            sparse.diags_array(masses.numpy()) + (self.wavelength / (2 * math.pi)) ** 2 * stiffness
        )

    def __call__(self, displacements: Tensor) -> Tensor:
        """The smooth part of displacements (B,V,C), of their unit, dtype and device; differentiable."""
        if displacements.ndim != 3 or displacements.shape[1] != len(self._masses):
            raise ShapeError(f"low_pass: found {tuple(displacements.shape)}, expected (B,{len(self._masses)},C)")
        count, _, channels = displacements.shape
        columns = displacements.transpose(0, 1).flatten(1)
        smooth = solved(self._factor, columns * self._masses.to(columns)[:, None])
        return smooth.unflatten(1, (count, channels)).transpose(0, 1)


def vertex_areas(neutral: Tensor, faces: Tensor) -> Tensor:
    """A third of the area of each vertex's triangles, (V,) float64 on the CPU, mm²; never 0."""
    areas = triangle_areas(neutral.detach().double().cpu(), faces.cpu())
    total = torch.zeros(len(neutral), dtype=torch.float64)
    for corner in faces.cpu().unbind(1):
        total.index_add_(0, corner, areas / 3)
    least = _LEAST_MASS * float(total.mean())
    return total.clamp(min=least if least > 0 else 1.0)


def small_part_triangles(neutral: Tensor, faces: Tensor) -> Tensor:
    """Mask (F,) of the triangles of loose parts with less than a tenth of the largest part's area."""
    part = components(faces, len(neutral))[faces[:, 0]]
    areas = part.new_zeros(len(neutral), dtype=torch.float64)
    areas.index_add_(0, part, triangle_areas(neutral.detach().double(), faces))
    return areas[part] < _SMALL_PART * areas.max()
