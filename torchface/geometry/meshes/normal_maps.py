"""Normal maps as data: unit vectors in tangent space, mixed by weight as the heights they come from would be."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError

__all__ = ["DetailMaps", "blend_normal_maps"]

_MIN_Z = 0.02  # a slope of 89 degrees; steeper ones have no finite height


@dataclass(frozen=True, eq=False)
class SurfaceMaps:
    """How a face at rest shades: unit normals in tangent space (3,H,W), and roughness from 0 to 1, (1,H,W)."""

    neutral: Tensor
    roughness: Tensor


@dataclass(frozen=True, eq=False)
class DetailMaps:
    """One normal map a shape, and the face's at rest.

    Args:
        names: of the shapes that have a map, no name twice.
        maps: the skin's normals at each shape's weight of 1, unit vectors, (N,3,H,W).
        neutral: the normals at rest, (3,H,W); flat where absent.

    Raises:
        ShapeError: the maps are not (N,3,H,W), or the neutral's has another size.
        NameMismatchError: not one name a map, or a name twice.
        ValueRangeError: a value is NaN or infinite.
    """

    names: tuple[str, ...]
    maps: Tensor
    neutral: Tensor | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        _check_maps(self.maps, self.neutral)
        if len(self.names) != len(self.maps):
            raise NameMismatchError(f"detail maps: found {len(self.names)} names for {len(self.maps)} maps")
        if len(set(self.names)) != len(self.names):
            twice = sorted({name for name in self.names if self.names.count(name) > 1})
            raise NameMismatchError(f"detail maps: found names more than once: {', '.join(twice[:5])}")

    def blend(self, names: Sequence[str], weights: Tensor) -> Tensor:
        """The map (3,H,W) at a rig's weights (N',), ignoring shapes without a map.

        Args:
            names: of the rig's shapes, N'.
            weights: one each.

        Raises:
            ShapeError: not one weight a name.
            NameMismatchError: the rig lacks a shape that has a map.
        """
        if weights.shape != (len(names),):
            raise ShapeError(f"weights: found {tuple(weights.shape)}, expected ({len(names)},)")
        row = {name: i for i, name in enumerate(names)}
        missing = [name for name in self.names if name not in row]
        if missing:
            raise NameMismatchError(f"detail maps: the rig has no shape {', '.join(map(repr, missing[:5]))}")
        return blend_normal_maps(self.maps, weights[[row[name] for name in self.names]], self.neutral)

    def reduced(self, side: int) -> "DetailMaps":
        """The maps with at most so many texels a side."""
        step = -(-max(self.maps.shape[-2:]) // side)
        if step <= 1:
            return self
        neutral = None if self.neutral is None else _pooled(self.neutral, step)
        return DetailMaps(self.names, _pooled(self.maps, step), neutral)

    def merged(self, sources: Mapping[str, Sequence[str]]) -> "DetailMaps":
        """The maps of shapes that are sums of these.

        Args:
            sources: for each new shape the names of those that add up to it; one without any map gets none.
        """
        row = {name: i for i, name in enumerate(self.names)}
        rows = {name: [row[part] for part in parts if part in row] for name, parts in sources.items()}
        rows = {name: found for name, found in rows.items() if found}
        maps = [blend_normal_maps(self.maps[found], torch.ones(len(found)), self.neutral) for found in rows.values()]
        return DetailMaps(tuple(rows), torch.stack(maps) if maps else self.maps[:0], self.neutral)


def _pooled(normals: Tensor, step: int) -> Tensor:
    return torch.nn.functional.normalize(torch.nn.functional.avg_pool2d(normals, step, ceil_mode=True), dim=-3)


def blend_normal_maps(maps: Tensor, weights: Tensor, neutral: Tensor | None = None) -> Tensor:
    r"""Mixes normal maps as if the height fields that they are the normals of were mixed.

    .. math:: s = s_0 + \sum_i w_i (s_i - s_0), \quad s = (n_x/n_z, n_y/n_z), \quad n \propto (s_x, s_y, 1)

    Slopes of heights add up, so the order of the maps has no meaning, zero weights give the neutral's map (flat where
    there is none) and a single weight of 1 gives that map.

    Args:
        maps: unit vectors :math:`n_i`, (N,3,H,W).
        weights: :math:`w`, (N,).
        neutral: the map at rest, (3,H,W).

    Returns:
        Unit vectors (3,H,W).

    Raises:
        ShapeError: the shapes do not fit.
        ValueRangeError: NaN or infinite.

    Source: partial-derivative blending, Hill and Barré-Brisebois 2012; thesis 3.2.1, equation 1, for the form.

    Example:
        >>> tilted = torch.tensor([0.6, 0.0, 0.8])[None, :, None, None].repeat(1, 1, 4, 4)
        >>> flat = blend_normal_maps(tilted, torch.zeros(1))
        >>> flat[:, 0, 0].tolist()
        [0.0, 0.0, 1.0]
    """
    _check_maps(maps, neutral)
    if weights.shape != (len(maps),):
        raise ShapeError(f"weights: found {tuple(weights.shape)}, expected ({len(maps)},)")
    if not torch.isfinite(weights).all():
        raise ValueRangeError("weights: found NaN or infinite, expected finite numbers")
    rest = torch.zeros_like(maps[0, :2]) if neutral is None and len(maps) else None
    if rest is None:
        if neutral is None:
            raise ShapeError("blend_normal_maps: found no map, expected at least one or a neutral's")
        rest = normal_slopes(neutral)
    total = rest * (1 - weights.sum().to(rest))
    for i in weights.nonzero()[:, 0].tolist():  # a loop over shapes: all at once would take gigabytes at 4096 squared
        total = total + weights[i].to(rest) * normal_slopes(maps[i])
    return torch.nn.functional.normalize(torch.cat([total, torch.ones_like(total[:1])]), dim=0)


def normal_slopes(normals: Tensor) -> Tensor:
    """Slopes (2,H,W) of the heights that unit vectors (3,H,W) are the normals of; (...,H,W) alike."""
    return normals[:2] / normals[2:].clamp(min=_MIN_Z)


def _check_maps(maps: Tensor, neutral: Tensor | None) -> None:
    if maps.ndim != 4 or maps.shape[1] != 3:
        raise ShapeError(f"normal maps: found {tuple(maps.shape)}, expected (N,3,H,W)")
    if neutral is not None and (neutral.ndim != 3 or (len(maps) and neutral.shape != maps.shape[1:])):
        expected = tuple(maps.shape[1:]) if len(maps) else "(3,H,W)"
        raise ShapeError(f"neutral normal map: found {tuple(neutral.shape)}, expected {expected}")
    for name, tensor in (("normal maps", maps), ("neutral normal map", neutral)):
        if tensor is not None and not torch.isfinite(tensor).all():
            raise ValueRangeError(f"{name}: found NaN or infinite values, expected unit vectors")


def flat_normal_map(height: int, width: int) -> Tensor:
    """The map (3,H,W) that changes nothing."""
    flat = torch.zeros(3, height, width, dtype=torch.float32)
    flat[2] = 1
    return flat


def encode_normals(normals: Tensor) -> Tensor:
    """The image (3,H,W) in [0,1] of unit vectors (3,H,W): red x, green y (up), blue z; flat is (0.5, 0.5, 1)."""
    return normals * 0.5 + 0.5


def decode_normals(image: Tensor) -> Tensor:
    """Unit vectors (3,H,W) of a normal map's image (3,H,W) in [0,1]; flat where the image holds no direction."""
    vectors = image * 2 - 1
    length = vectors.norm(dim=0, keepdim=True)
    flat = flat_normal_map(*image.shape[1:]).to(image)
    return torch.where(length > 1e-3, vectors / length.clamp(min=1e-3), flat)
