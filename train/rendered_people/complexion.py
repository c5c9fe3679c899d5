"""The variation of skin between performers: melanin, blood, lips, hair, shadows under the eyes."""

from functools import lru_cache

import torch
from torch import Tensor

from torchface.color_space import to_linear, to_srgb
from torchface.errors import ShapeError
from torchface.synthetic.head.neutral_head import neutral_head

COMPLEXION = ("melanin", "redness", "lips", "hair", "shadows", "flush")
"""The parameters, in standard deviations: pigment, blood in all the skin, colour of the lips, darkness of brows and
scalp, shadows round the eyes, blood in cheeks and nose."""

_MELANIN = (-0.10, -0.18, -0.27)
_BLOOD = (-0.02, -0.09, -0.06)
_FLUSH = (-0.01, -0.055, -0.04)
_LIPS = (-0.06, -0.22, -0.14)
_SHADOW = (-0.16, -0.20, -0.16)
_HAIR = (-0.35, -0.35, -0.33)
_SKEW = 0.6


def draw_complexions(count: int, generator: torch.Generator, scale: float = 1.0) -> Tensor:
    """Complexions (N,6) drawn from a normal distribution with ``scale`` standard deviations."""
    return scale * torch.randn(count, len(COMPLEXION), generator=generator)


def complexion_colors(complexions: Tensor) -> Tensor:
    r"""The colours of the head's vertices for each complexion.

    .. math:: \log \rho_v = \log \bar\rho_v + \sum_j f_{vj}\, (e^{s c_j} - 1) / s

    in linear light, as pigments absorb: each parameter has a field over the skin, and more of it goes further than
    less (s = 0.6). Eyes and the inside of the mouth stay.

    Args:
        complexions: (N,6), standard deviations, in the order of ``COMPLEXION``.

    Returns:
        sRGB colours (N,V,3) of ``neutral_head()``'s vertices, in [0,1].
    """
    if complexions.ndim != 2 or complexions.shape[1] != len(COMPLEXION):
        raise ShapeError(f"complexions: found {tuple(complexions.shape)}, expected (N,{len(COMPLEXION)})")
    base, fields = _skin()
    amounts = torch.expm1(_SKEW * complexions.to(fields)) / _SKEW
    light = base * torch.tensordot(amounts, fields, 1).exp()
    return to_srgb(light).clamp(0, 1)


@lru_cache(maxsize=1)
def _skin() -> tuple[Tensor, Tensor]:
    """The mean colours in linear light (V,3), and what a unit of each parameter adds to their logarithm, (6,V,3)."""
    mesh = neutral_head()
    assert mesh.texture is not None
    assert mesh.uvs is not None
    assert mesh.uv_faces is not None
    assert mesh.annotations is not None
    corner = torch.zeros(len(mesh.vertices), dtype=torch.int64)
    corner[mesh.faces.flatten()] = mesh.uv_faces.flatten()
    grid = torch.stack([2 * mesh.uvs[corner, 0] - 1, 1 - 2 * mesh.uvs[corner, 1]], dim=1)[None, None]
    colors = torch.nn.functional.grid_sample(mesh.texture[None], grid, align_corners=False)[0, :, 0].T
    base = to_linear(colors)
    regions = {name: mask.float() for name, mask in mesh.annotations.regions.items()}
    inside = sum(regions[n] for n in ("eyeball_left", "eyeball_right", "mouth_interior", "eye_sockets"))
    skin = 1 - torch.as_tensor(inside).clamp(max=1)
    lips = _smoothed(regions["upper_lip"] + regions["lower_lip"], mesh.faces, 1) * skin
    brows = _smoothed(regions["brow_left"] + regions["brow_right"], mesh.faces, 1) * skin
    dark = (base.mean(1) < 0.5 * base[regions["forehead"] > 0].mean()).float()
    hair = torch.maximum(brows * dark, _smoothed(regions["cranium"] * dark, mesh.faces, 2)) * skin
    lids = _smoothed(regions["lids_left"] + regions["lids_right"], mesh.faces, 4) * skin * (1 - brows)
    flush = (
        _smoothed(regions["cheek_left"] + regions["cheek_right"] + regions["nose"], mesh.faces, 6) * skin * (1 - lips)
    )
    bare = skin * (1 - hair)
    pairs = [(bare, _MELANIN), (bare, _BLOOD), (lips, _LIPS), (hair, _HAIR), (lids, _SHADOW), (flush, _FLUSH)]
    return base, torch.stack([field[:, None] * torch.tensor(tint) for field, tint in pairs])


def _smoothed(field: Tensor, faces: Tensor, iterations: int) -> Tensor:
    """A field (V,) averaged with its neighbours, iteratively, clipped to [0,1]."""
    count = torch.zeros(len(field)).index_add_(0, faces.flatten(), torch.ones(faces.numel()))
    for _ in range(iterations):
        mean = field[faces].mean(1)
        field = torch.zeros(len(field)).index_add_(0, faces.flatten(), mean.repeat_interleave(3)) / count.clamp(min=1)
    return field.clamp(0, 1)
