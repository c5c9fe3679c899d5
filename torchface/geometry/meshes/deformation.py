"""Deformation gradients of triangles with a fourth vertex, and the sparse operator that computes them."""

import torch
from scipy import sparse
from torch import Tensor

from torchface.geometry.meshes.operators import corners, triangle_cross


def triangle_frames(vertices: Tensor, faces: Tensor) -> Tensor:
    r"""The matrix (...,F,3,3) of two edges and a scaled normal of each triangle, as columns; the third 0 without area.

    .. math:: V = [v_2 - v_1,\; v_3 - v_1,\; v_4 - v_1], \quad v_4 - v_1 = n / \sqrt{|n|}, \quad
        n = (v_2 - v_1) \times (v_3 - v_1)

    Source: thesis 3.3.1, equations 18 and 20.
    """
    a, b, c = corners(vertices, faces)
    cross = triangle_cross(vertices, faces)
    length = cross.norm(dim=-1, keepdim=True)
    fourth = torch.where(length > 0, cross / length.clamp(min=torch.finfo(vertices.dtype).tiny).sqrt(), 0.0)
    return torch.stack([b - a, c - a, fourth], dim=-1)


def degenerate_triangles(vertices: Tensor, faces: Tensor, tolerance: float = 1e-6) -> Tensor:
    """Mask (...,F) of triangles without area: lower than ``tolerance`` times their longest edge."""
    a, b, c = corners(vertices, faces)
    longest = torch.stack([b - a, c - b, a - c]).square().sum(-1).amax(0)
    return triangle_cross(vertices, faces).norm(dim=-1) <= tolerance * longest


def deformation_gradients(rest: Tensor, deformed: Tensor, faces: Tensor) -> Tensor:
    r"""The linear part (...,F,3,3) of the affine map that carries each triangle from rest to its deformed place.

    .. math:: Q = \tilde V V^{-1}

    A triangle that has no area at rest has no gradient: it gets the identity. One that loses its area keeps the
    gradient of its edges; its normal is mapped to zero.

    Source: thesis 3.3.1, equations 19 to 21; Sumner and Popovic 2004.
    """
    frames = triangle_frames(rest, faces)
    flat = degenerate_triangles(rest, faces)
    identity = torch.eye(3, dtype=rest.dtype, device=rest.device)
    inverse = torch.linalg.inv(torch.where(flat[:, None, None], identity, frames))
    return torch.where(flat[:, None, None], identity, triangle_frames(deformed, faces) @ inverse)


def gradient_operator(vertices: Tensor, faces: Tensor) -> sparse.csr_array:
    r"""The operator that reads the tangential part of every triangle's deformation gradient from vertex positions.

    With :math:`g_1, g_2, g_3` the gradients of the corners' hat functions, :math:`g_2, g_3` rows of the pseudo-inverse
    of :math:`[v_2 - v_1,\; v_3 - v_1]` and :math:`g_1 = -g_2 - g_3`,

    .. math:: (A \tilde x)_t = \sum_{k=1}^{3} g_k \tilde v_k^\top = P_t Q_t^\top,

    where :math:`P_t` projects onto the triangle's plane. It is equation 25's matrix with the fourth vertices
    eliminated: each belongs to one triangle only and takes up the gradient along the normal without residual.

    Args:
        vertices: the mesh at rest, (V,3), millimetres.

    Returns:
        A matrix (3F,V); row 3t+i is the derivative along axis i on triangle t. A triangle without area has no rows.

    Source: thesis 3.3.1, equations 22 to 25; Botsch, Sumner, Pauly, Gross 2006 for the elimination.
    """
    rest = vertices.double().cpu()
    faces = faces.cpu()
    a, b, c = corners(rest, faces)
    cross = triangle_cross(rest, faces)
    square = cross.square().sum(-1, keepdim=True)
    flat = degenerate_triangles(rest, faces)[:, None]
    # The hat function of a corner rises across its opposite edge: n x edge / |n|^2.
    opposite = torch.stack([c - b, a - c, b - a])
    hats = torch.linalg.cross(cross.expand_as(opposite), opposite) / square.masked_fill(flat, 1.0)
    hats = hats.masked_fill(flat, 0.0)
    rows = torch.arange(3 * len(faces)).view(-1, 3)
    entries = sparse.coo_array(
        (
            hats.permute(1, 2, 0).flatten().numpy(),
            (rows[:, :, None].expand(-1, -1, 3).flatten().numpy(), faces[:, None].expand(-1, 3, -1).flatten().numpy()),
        ),
        shape=(3 * len(faces), len(vertices)),
    )
    return entries.tocsr()
