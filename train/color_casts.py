"""Colours of many scans on one topology, freed from each scan's exposure and white balance."""

import torch
from torch import Tensor

from torchface.color_space import to_linear, to_srgb
from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.mesh import Mesh

_DARK, _BRIGHT = 0.02, 0.98
_STEPS = 20
_TOLERANCE = 1e-5
_UNALIKE = 0.15
"""In natural logarithms of light: a brow where others have none is no sign of another exposure."""


def color_casts(colors: Tensor, weights: Tensor | None = None) -> Tensor:
    r"""The gain of each channel that exposure and white balance have put on each scan, beside the others.

    .. math:: \log x_{mvc} = \log \rho_{mvc} + g_{mc}, \qquad
        \min_{g, \bar\rho} \sum_{mvc} w_v\, \phi\big(\log x_{mvc} - g_{mc} - \log \bar\rho_{vc}\big),
        \quad \sum_m g_{mc} = 0

    with x in linear light and Geman and McClure's :math:`\phi` (width 0.15), so that beards, brows and make-up of some
    do not count as the light of all. Clipped values (below 0.02, above 0.98) are left out. What makes one person's
    skin darker as a whole cannot be distinguished from exposure and counts as such.

    Args:
        colors: of the same vertices, (M,V,3) in [0,1], sRGB as textures hold them.
        weights: of the vertices, (V,), such as :func:`texture_areas`; equal if absent.

    Returns:
        :math:`g`, natural logarithms of the gains in linear light, (M,3) float64; their mean over the scans is 0.

    Source: thesis 3.2.4 (textures in UV space); Blanz, Vetter 1999 (gain and offset of a channel).

    Example:
        >>> skin = torch.full((1, 50, 3), 0.5)
        >>> casts = color_casts(torch.cat([skin, skin * torch.tensor([1.2, 1.0, 1.0])]))
        >>> bool(casts[1, 0] > 0.1 > casts[1, 1].abs())  # the second scan is too red
        True
    """
    if colors.ndim != 3 or colors.shape[2] != 3:
        raise ShapeError(f"colors: found {tuple(colors.shape)}, expected (M,V,3)")
    if weights is None:
        weights = torch.ones(colors.shape[1])
    if weights.shape != (colors.shape[1],):
        raise ShapeError(f"weights: found {tuple(weights.shape)}, expected ({colors.shape[1]},)")
    if not bool(torch.isfinite(colors).all()):
        raise ValueRangeError("colors: found NaN or infinity, expected colours in [0,1]")
    valid = ((colors > _DARK) & (colors < _BRIGHT)).float() * weights.to(colors)[None, :, None]
    sampled = valid.sum(1)
    if bool((sampled <= 0).any()):
        bad = int((sampled <= 0).any(1).nonzero()[0, 0])
        raise ValueRangeError(f"colors: number {bad} is black or blown out everywhere, expected some colours between")
    light = to_linear(colors.clamp(_DARK, _BRIGHT)).log()
    gains = (valid * light).sum(1) / sampled
    gains -= gains.mean(0)
    robust = valid
    for _ in range(_STEPS):
        reference = (robust * (light - gains[:, None])).sum(0) / robust.sum(0).clamp(min=1e-9)
        left = light - reference
        robust = valid * (1 + ((left - gains[:, None]) / _UNALIKE).square()).pow(-2)
        casts = (robust * left).sum(1) / robust.sum(1).clamp(min=1e-9)
        casts -= casts.mean(0)
        moved, gains = float((casts - gains).abs().max()), casts
        if moved < _TOLERANCE:
            break
    return gains.double()


def without_cast(colors: Tensor, cast: Tensor) -> Tensor:
    """Colours as the scans' common light would show them.

    Example:
        >>> skin = torch.full((1, 50, 3), 0.5)
        >>> scans = torch.cat([skin, skin * torch.tensor([1.2, 1.0, 1.0])])
        >>> neutral = without_cast(scans, color_casts(scans))
        >>> bool((neutral[0] - neutral[1]).abs().max() < 0.01)
        True
    """
    return to_srgb(to_linear(colors) * (-cast[:, None]).exp().to(colors)).clamp(0, 1)


def texture_areas(mesh: Mesh) -> Tensor:
    """Each vertex's share of the area of the texture, (V,); how many texels would speak for it.

    Example:
        >>> corners = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
        >>> quad = torch.tensor([[0, 1, 2], [0, 2, 3]])
        >>> square = Mesh(torch.nn.functional.pad(corners, (0, 1)), quad, uvs=corners, uv_faces=quad)
        >>> areas = texture_areas(square)
        >>> round((areas[0] / areas[1]).item(), 3)  # vertex 0 has two triangles, vertex 1 has one
        2.0
    """
    if mesh.uvs is None or mesh.uv_faces is None:
        raise TopologyError("mesh: found no texture coordinates, expected some to weigh colours in")
    a, b, c = mesh.uvs.double()[mesh.uv_faces].unbind(1)
    area = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).abs() / 2
    shares = torch.zeros(len(mesh.vertices), dtype=torch.float64, device=area.device)
    shares.index_add_(0, mesh.faces.flatten(), area.repeat_interleave(3) / 3)
    return (shares / shares.sum().clamp(min=1e-12)).float()
