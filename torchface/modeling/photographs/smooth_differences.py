"""Smooth differences of heads that a head model does not know: modes of a Gaussian process."""

import torch
from torch import Tensor

_LENGTH = 20.0  # millimetres over which a difference is alike
_MODES = 20  # an axis
_LEAST_VARIANCE = 1e-3


def smooth_differences(vertices: Tensor, landmarks: Tensor, deviation: float) -> Tensor:
    r"""The ways in which heads differ smoothly and alike on both sides, likeliest first for each axis, (M,V,3).

    .. math:: u(x) \sim GP\bigl(0,\; s^2 \exp(-\lVert x - y \rVert^2 / 2 l^2)\bigr), \quad l = 20\,\text{mm}

    made symmetric about x = 0, known at the landmarks, and elsewhere what those lead to expect.

    Args:
        vertices: of the mean head, (V,3), millimetres.
        landmarks: vertex ids, (L,).
        deviation: s, of a coordinate, millimetres; 0 gives no modes.

    Source: Lüthi, Gerig, Jud and Vetter 2018 (Gaussian process morphable models).
    """
    x = vertices.detach().cpu().double()
    if deviation == 0:
        return x.new_zeros(0, *x.shape, dtype=torch.float32)
    at = x[landmarks]
    mirrored = at * at.new_tensor([-1.0, 1.0, 1.0])
    modes = []
    for axis in range(3):
        sign = -1.0 if axis == 0 else 1.0
        values, vectors = torch.linalg.eigh(_symmetric(at, at, mirrored, sign))
        kept = values.flip(0)[:_MODES] > _LEAST_VARIANCE
        values, vectors = values.flip(0)[:_MODES][kept], vectors.flip(1)[:, :_MODES][:, kept]
        field = x.new_zeros(len(values), *x.shape)
        field[..., axis] = deviation * (_symmetric(x, at, mirrored, sign) @ vectors / values.sqrt()).T
        modes.append(field)
    return torch.cat(modes).float()


def _symmetric(x: Tensor, at: Tensor, mirrored: Tensor, sign: float) -> Tensor:
    """The covariance (X,L) of the half of a field that is the mirror image of itself."""
    near, across = (torch.exp(-torch.cdist(x, y).square() / (2 * _LENGTH**2)) for y in (at, mirrored))
    both = 0.5 * (near + sign * across)
    return 0.5 * (both + both.T) if len(both) == len(at) else both
