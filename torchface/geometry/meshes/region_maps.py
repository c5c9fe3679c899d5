"""Wrinkle maps that regions mix each for itself: few textures, many patterns."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.geometry.meshes.normal_maps import normal_slopes

__all__ = ["RegionMaps"]


@dataclass(frozen=True, eq=False)
class RegionMaps:
    r"""Normal and displacement maps in texture space, of which each region has weights of its own.

    .. math:: s = s_0 + \sum_m (s_m - s_0) \sum_r \omega_r w_{rm}, \qquad h = \sum_m h_m \sum_r \omega_r w_{rm}

    with slopes :math:`s = (n_x/n_z, n_y/n_z)` of normals :math:`n \propto (s_x, s_y, 1)`.

    Args:
        regions: names of the R regions, no name twice.
        normals: of the skin with one map everywhere at 1, unit vectors in tangent space, (M,3,H,W).
        heights: by which it then stands out along the normal, millimetres, (M,H,W).
        masks: :math:`\omega`, the share of each region in each texel, (R,h,w), in [0,1]; of any size.
        neutral: the normals at rest, (3,H,W).

    Raises:
        ShapeError: the shapes do not fit each other.
        NameMismatchError: not one name a mask, or a name twice.
        ValueRangeError: a value is NaN or infinite, or a mask is not in [0,1].
    """

    regions: tuple[str, ...]
    normals: Tensor
    heights: Tensor
    masks: Tensor
    neutral: Tensor

    def __post_init__(self) -> None:
        object.__setattr__(self, "regions", tuple(self.regions))
        sizes = [tuple(one.shape) for one in (self.normals, self.heights, self.masks, self.neutral)]
        count, size = sizes[0][:1], sizes[0][2:]
        fits = self.normals.ndim == 4 and sizes[0][1] == 3 and sizes[1] == (*count, *size) and sizes[3] == (3, *size)
        if not fits or not count[0] or self.masks.ndim != 3:
            found = ", ".join(map(str, sizes))
            raise ShapeError(f"region maps: found {found}, expected (M,3,H,W), (M,H,W), (R,h,w) and (3,H,W)")
        if len(self.regions) != len(self.masks) or len(set(self.regions)) != len(self.regions):
            raise NameMismatchError(
                f"region maps: found {len(self.masks)} masks for {', '.join(self.regions[:5])}, expected a region each"
            )
        for name in ("normals", "heights", "masks", "neutral"):
            if not bool(torch.isfinite(getattr(self, name)).all()):
                raise ValueRangeError(f"region maps: found NaN or infinite values in the {name}, expected numbers")
        if self.masks.numel() and not 0 <= float(self.masks.min()) <= float(self.masks.max()) <= 1:
            raise ValueRangeError("region maps: found a mask outside [0,1]")

    def shares(self, weights: Tensor) -> Tensor:
        """How much of each map each texel shows, (M,H,W), at weights (R,M).

        Raises:
            ShapeError: weights of other regions or maps.
        """
        if weights.shape != (len(self.regions), len(self.normals)):
            expected = (len(self.regions), len(self.normals))
            raise ShapeError(f"map weights: found {tuple(weights.shape)}, expected {expected}")
        own = torch.einsum("rhw,rm->mhw", self.masks, weights.to(self.masks))
        size = self.neutral.shape[1:]
        return torch.nn.functional.interpolate(own[None], size, mode="bilinear", align_corners=False)[0]

    def blend(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Normals (3,H,W) and heights (H,W), millimetres, at weights (R,M); zeros give the face at rest."""
        shares = self.shares(weights)
        rest = normal_slopes(self.neutral)
        slopes = rest.clone()
        for share, normals in zip(shares, self.normals, strict=True):  # a loop over maps: all would take gigabytes
            slopes += share * (normal_slopes(normals) - rest)
        normals = torch.nn.functional.normalize(torch.cat([slopes, torch.ones_like(slopes[:1])]), dim=0)
        return normals, (shares * self.heights).sum(0)
