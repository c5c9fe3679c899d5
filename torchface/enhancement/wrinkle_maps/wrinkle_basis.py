"""A few maps that together show an actor's wrinkles: weights of regions say how much of each is seen where."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.enhancement.detail.detail_basis import LearnedBasis
from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import checked_count
from torchface.optim.box_qp import box_qp

MAPS = 4
_ITERATIONS = 15
_SAMPLED = 20_000  # vertices on which weights and maps are found in turns
_CHUNK = 8192  # vertices
_RIDGE = 1e-4  # of the mean of the diagonal: where two maps show the same, both share it


@dataclass(frozen=True, eq=False)
class WrinkleBasis:
    r"""Displacements of the skin as a sum of few maps.

    .. math:: d_t(v) = \sum_m B_m(v) \sum_r \omega_r(v)\, w_{trm}, \qquad 0 \le w \le 1

    A map holds something else in each region, as the regions' weights are their own: M maps and R regions show M·R
    patterns of wrinkles.
    """

    maps: Tensor  # B, (M,3,V), millimetres along two tangents and the normal of the smooth skin
    region_weights: Tensor  # \omega, (R,V), of sum 1 in every vertex
    areas: Tensor

    def weights(self, details: LearnedBasis) -> Tensor:
        """The weights (T,R,M) that show details, given by their components and coefficients (T,r), best."""
        hessian, linear = _system(self.maps, self.region_weights, self.areas, details.components)
        return _solved(hessian, linear, details.coefficients).unflatten(1, (len(self.region_weights), len(self.maps)))

    def details(self, weights: Tensor) -> Tensor:
        """Displacements (T,3V) at weights (T,R,M), millimetres; differentiable."""
        if weights.ndim != 3 or weights.shape[1:] != (len(self.region_weights), len(self.maps)):
            expected = f"(T,{len(self.region_weights)},{len(self.maps)})"
            raise ShapeError(f"wrinkle weights: found {tuple(weights.shape)}, expected {expected}")
        total = weights.new_zeros(len(weights), 3, self.maps.shape[2])
        for number, one in enumerate(self.maps.to(weights)):  # map by map: all at once would take gigabytes
            total = total + (weights[:, :, number] @ self.region_weights.to(weights))[:, None] * one
        return total.flatten(1)

    def missed_share(self, weights: Tensor, details: LearnedBasis) -> float:
        """What weights (T,R,M) leave of the details, root mean square over the area, as a share of theirs."""
        hessian, linear = _system(self.maps, self.region_weights, self.areas, details.components)
        known, rows = details.coefficients.double(), weights.double().flatten(1)
        energy = ((known @ _gram(details.components, self.areas)) * known).sum()
        left = energy + ((rows @ hessian) * rows).sum() - 2 * ((known @ linear.T) * rows).sum()
        return float((left.clamp(min=0) / energy.clamp(min=1e-30)).sqrt())


def learn_wrinkle_basis(
    details: LearnedBasis, region_weights: Tensor, areas: Tensor, count: int = MAPS
) -> WrinkleBasis:
    """The maps that show details best with non-negative weights.

    Begins with the frames of each region that differ most from all before them. Then weights (a quadratic program a
    frame) and maps (least squares a vertex) are found in turns, as in semi-non-negative matrix factorisation, here
    with the regions' soft borders in both.

    Source: Ding, Li, Jordan 2010, Convex and semi-nonnegative matrix factorizations.
    """
    checked_count("maps", count, 1)
    vertices = region_weights.shape[1]
    if details.components.shape[1] != 3 * vertices or len(areas) != vertices:
        raise ShapeError(
            f"wrinkle basis: found components {tuple(details.components.shape)}, region weights "
            f"{tuple(region_weights.shape)} and areas {tuple(areas.shape)}, expected (r,3V), (R,V) and (V,)"
        )
    if len(details.coefficients) < count:
        raise ValueRangeError(
            f"maps: found {count} for {len(details.coefficients)} frames, expected at most as many as frames"
        )
    if not float(details.coefficients.abs().max()) > 0:
        raise ValueRangeError("wrinkle basis: found frames without detail, expected an actor's wrinkles")
    generator = torch.Generator().manual_seed(0)
    some = torch.randperm(vertices, generator=generator)[:_SAMPLED].sort().values
    own = details.components.unflatten(1, (3, -1))[:, :, some].flatten(1)
    shares, sizes = region_weights[:, some], areas[some]
    weights = _extremes(own, details.coefficients, shares, sizes, count)
    for _ in range(_ITERATIONS):
        weights = _full_range(weights)
        maps = _maps(weights, own, details.coefficients, shares)
        hessian, linear = _system(maps, shares, sizes, own)
        weights = _solved(hessian, linear, details.coefficients).view_as(weights)
    maps = _maps(_full_range(weights), details.components, details.coefficients, region_weights)
    return WrinkleBasis(maps, region_weights, areas)


def _extremes(components: Tensor, known: Tensor, shares: Tensor, areas: Tensor, count: int) -> Tensor:
    """First weights (K,R,M): of the frames of each region that differ most from combinations of the others chosen."""
    extremes = []
    for share in shares:
        gram = known.double() @ _gram(components, share * areas) @ known.double().T
        left, chosen = gram.clone(), []
        for _ in range(count):
            pick = int(left.diagonal().argmax())
            chosen.append(pick)
            column = left[:, pick].clone()
            left -= column[:, None] * column / column[pick].clamp(min=1e-30)
        extremes.append(_solved(gram[chosen][:, chosen], gram[chosen], torch.eye(len(known))))
    return torch.stack(extremes, dim=1)


def _full_range(weights: Tensor) -> Tensor:
    """Scaled so that each reaches 1 in some frame."""
    return weights / weights.amax(0).clamp(min=1e-9)


def _maps(weights: Tensor, components: Tensor, known: Tensor, shares: Tensor) -> Tensor:
    """The maps (M,3,V) that least squares has for weights (K,R,M), vertex by vertex."""
    regions, count = weights.shape[1:]
    rows = weights.double().flatten(1)
    pairs = (rows.T @ rows).view(regions, -1)
    against = (rows.T @ known.double()).float().view(regions, -1)
    ridge = _RIDGE * float(pairs.view(regions * count, -1).diagonal().mean()) * torch.eye(count)
    fields = components.unflatten(1, (3, -1))
    maps = torch.empty(count, 3, shares.shape[1])
    for begin in range(0, shares.shape[1], _CHUNK):
        piece = slice(begin, begin + _CHUNK)
        share = shares[:, piece].T
        half = (share @ pairs.float()).view(-1, count, regions, count)
        system = torch.einsum("vmrn,vr->vmn", half, share) + ridge
        wanted = (share @ against).view(len(share), count, -1) @ fields[:, :, piece].float().permute(2, 0, 1)
        maps[:, :, piece] = torch.linalg.solve(system.double(), wanted.double()).float().permute(1, 2, 0)
    return maps


def _system(maps: Tensor, shares: Tensor, areas: Tensor, components: Tensor) -> tuple[Tensor, Tensor]:
    """The quadratic form of all weights, (RM,RM), and what coefficients pull at them, (RM,r)."""
    count = shares.shape[0] * maps.shape[0]
    hessian = torch.zeros(count, count, dtype=torch.float64)
    linear = torch.zeros(count, len(components), dtype=torch.float64)
    fields = components.unflatten(1, (3, -1))
    for begin in range(0, shares.shape[1], _CHUNK):
        piece = slice(begin, begin + _CHUNK)
        parts = (shares[:, None, None, piece] * maps[None, :, :, piece]).reshape(count, -1)
        weighed = parts * areas[piece].float().repeat(3)
        hessian += weighed @ parts.T
        linear += weighed @ fields[:, :, piece].float().flatten(1).T
    return hessian, linear


def _gram(components: Tensor, areas: Tensor) -> Tensor:
    fields = components.unflatten(1, (3, -1))
    total = torch.zeros(len(components), len(components), dtype=torch.float64)
    for begin in range(0, len(areas), _CHUNK):
        own = fields[:, :, begin : begin + _CHUNK].float().flatten(1)
        total += (own * areas[begin : begin + _CHUNK].float().repeat(3)) @ own.T
    return total


def _solved(hessian: Tensor, linear: Tensor, coefficients: Tensor) -> Tensor:
    """Weights in [0,1], (K,n), of coefficients (K,r)."""
    mean = float(hessian.diagonal().mean())
    if mean <= 0:
        return torch.zeros(len(coefficients), len(hessian))
    ridge = _RIDGE * mean * torch.eye(len(hessian), dtype=hessian.dtype)
    scaled = (hessian + hessian.T) / (2 * mean) + ridge / mean
    return box_qp(scaled, -(coefficients.double() @ linear.double().T) / mean).float()
