"""From a rig's pose to the weights of wrinkle maps: small enough for an engine's every frame."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.number_checks import as_real, checked_count
from torchface.optim.eigenpairs import largest_eigenpairs
from torchface.optim.full_precision import full_precision
from torchface.rig import BlendshapeRig

SITES = 2000  # vertices that are looked at: of a face more would only say the same again

ROTATION_STEPS = 7
"""Of the iteration that finds how the head is turned: a matrix half strained away is a rotation to all digits."""

_COMPONENTS = 12
_LEAST_MOTION = 0.3  # millimetres, root mean square: what moves less in a region may be rounding
_AT_REST = 3  # how often the neutral is learned, whose weights are known to be zero
_SAME_NEUTRAL = 0.01  # millimetres
_REACHES = (0.5, 1.0, 2.0, 4.0)  # of a kernel, in units of the poses' spread
_RIDGES = (1e-2, 1e-1, 1.0)


class WrinkleWeights(nn.Module):
    r"""Weights of wrinkle maps, by region, of a rig's vertices.

    The pose is aligned with the neutral (the rotation nearest to the best linear map from the neutral); each region
    sees few principal components z of the displacements in it and nothing else; the weights are

    .. math:: w = \operatorname{clip}_{[0,1]}\bigl(g(z) - g(0)\bigr), \quad g(z) = A z +
        \sum_k \alpha_k \exp\bigl(-\lVert z - z_k \rVert^2 / 2 \ell^2\bigr),

    kernel ridge regression whose reach and ridge leave-one-out errors choose. The neutral has weights of zero; beyond
    the poses that were learned the linear part goes on, within [0,1].

    All that it needs of the displacements is linear in them (:meth:`moments`), so blendshape weights give the same
    answer without any vertex, see :class:`RigWrinkles`.
    """

    sites: Tensor
    rows: Tensor
    neutral: Tensor
    resting: Tensor
    centers: Tensor
    coefficients: Tensor
    linear: Tensor
    bias: Tensor
    sharpness: Tensor

    def __init__(
        self, region_names: Sequence[str], maps: int, vertices: int, sites: int, components: int, centers: int
    ) -> None:
        super().__init__()
        self.region_names, self.vertex_count = tuple(region_names), vertices
        regions = len(self.region_names)
        self.register_buffer("sites", torch.zeros(sites, dtype=torch.int64))
        self.register_buffer("rows", torch.zeros(3 + 3 * regions * components, sites))
        self.register_buffer("neutral", torch.zeros(sites, 3))
        self.register_buffer("resting", torch.zeros(3 + 3 * regions * components, 3))
        self.register_buffer("centers", torch.zeros(regions, centers, components))
        self.register_buffer("coefficients", torch.zeros(regions, centers, maps))
        self.register_buffer("linear", torch.zeros(regions, components, maps))
        self.register_buffer("bias", torch.zeros(regions, 1, maps))
        self.register_buffer("sharpness", torch.ones(regions, 1, 1))

    @property
    def config(self) -> dict[str, Any]:
        """What the constructor needs: plain values only."""
        _, centers, components = self.centers.shape
        return {
            "region_names": list(self.region_names),
            "maps": self.linear.shape[2],
            "vertices": self.vertex_count,
            "sites": len(self.sites),
            "components": components,
            "centers": centers,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "WrinkleWeights":
        """A module of zeros for the state to be loaded into."""
        return cls(**config)

    @classmethod
    def fit(
        cls,
        neutral: Tensor,
        poses: Tensor,
        weights: Tensor,
        region_weights: Tensor,
        region_names: Sequence[str],
        sites: Tensor | None = None,
        components: int = _COMPONENTS,
    ) -> "WrinkleWeights":
        """Learns from poses (K,V,3) whose weights (K,R,M) are known, each in any rigid place, by some 2,000
        vertices."""
        regions, vertices = region_weights.shape
        shapes = poses.shape[1:] == neutral.shape == (vertices, 3) and weights.shape[:2] == (len(poses), regions)
        if not shapes or weights.ndim != 3 or len(region_names) != regions:
            raise ShapeError(
                f"wrinkle weights: found a neutral {tuple(neutral.shape)}, poses {tuple(poses.shape)}, weights "
                f"{tuple(weights.shape)} and {len(region_names)} regions {tuple(region_weights.shape)}, expected "
                "(V,3), (K,V,3), (K,R,M) and (R,V)"
            )
        if len(poses) < 2:
            raise ValueRangeError(f"wrinkle weights: found {len(poses)} poses, expected two or more")
        for name, values in (("neutral", neutral), ("poses", poses), ("weights", weights)):
            if not bool(torch.isfinite(values).all()):
                raise ValueRangeError(f"wrinkle weights: found NaN or infinity in the {name}, expected numbers")
        checked_count("components", components, 1)
        if sites is None:
            sites = torch.linspace(0, vertices - 1, min(SITES, vertices)).round().long()
        model = cls(region_names, weights.shape[2], vertices, len(sites), components, len(poses) + _AT_REST)
        model.sites = sites.clone()
        poses = torch.cat([neutral[None].expand(_AT_REST, -1, -1), poses])[:, sites]
        weights = torch.cat([weights.new_zeros(_AT_REST, *weights.shape[1:]), weights])
        model._set_rows(neutral[sites].double(), poses.double(), region_weights[:, sites].double())
        scores = model._scores(model.moments(poses.float() - model.neutral))
        for region in range(regions):  # each has a kernel of its own
            model._learn(region, scores[region].double(), weights[:, region].double())
        return model.eval()

    def of_whole(self, vertices: Tensor, count: int) -> "WrinkleWeights":
        """The same for a rig of ``count`` vertices, of which those learned from are ``vertices`` (V,)."""
        whole = copy.deepcopy(self)
        whole.sites, whole.vertex_count = vertices[self.sites], count
        return whole

    @full_precision
    def forward(self, vertices: Tensor) -> Tensor:
        """Weights of the maps, (T,R,M), in [0,1], of the rig's vertices (T,V,3), millimetres, in any rigid place."""
        vertices = as_real(vertices, "vertices").to(self.rows)
        if vertices.ndim != 3 or vertices.shape[1:] != (self.vertex_count, 3):
            raise TopologyError(
                f"vertices: found {tuple(vertices.shape)}, expected (T,{self.vertex_count},3): poses of the rig that "
                "the weights were learned for"
            )
        return self.of_moments(self.moments(vertices.index_select(1, self.sites) - self.neutral))

    def predict(self, vertices: Tensor) -> Tensor:
        """As :meth:`forward`, which an engine has as a graph, with its numbers checked."""
        vertices = as_real(vertices, "vertices")
        bad = (~torch.isfinite(vertices)).flatten(1).any(1).nonzero()[:, 0]
        if len(bad):
            raise ValueRangeError(f"vertices: frame {int(bad[0])} holds NaN or infinity, expected millimetres")
        return self.forward(vertices)

    def moments(self, displacements: Tensor) -> Tensor:
        """The sums over displacements of the sites (T,S,3) of which all else is made, (T,3+3Rq,3); linear in them."""
        return self.rows @ (displacements - displacements[:, :1])

    def of_moments(self, moments: Tensor) -> Tensor:
        """Weights (T,R,M) of :meth:`moments`."""
        scores = self._scores(moments)
        return (self._value(scores) - self.value_at_rest).clamp(0, 1).transpose(0, 1)

    @property
    def value_at_rest(self) -> Tensor:
        """What regression says of the neutral, (R,1,M): taken off, for there is nothing."""
        return self._value(torch.zeros_like(self.centers[:, :1]))

    def _scores(self, moments: Tensor) -> Tensor:
        """Components of the displacements in each region, (R,T,q), of moments (T,3+3Rq,3)."""
        # In double precision, as a turn of a millionth moves a whole head's sums more than some wrinkle does.
        turn = nearest_rotation((self.resting[:3] + moments[:, :3]).double())
        upright = torch.eye(3, dtype=turn.dtype, device=turn.device)
        beyond, upright = (turn - upright).to(moments)[:, None, None], upright.to(moments)
        shape = (self.centers.shape[0], self.centers.shape[2], 3)
        moved, still = moments[:, 3:].unflatten(1, shape), self.resting[3:].unflatten(0, shape)
        return (moved * upright + (moved + still) * beyond).sum((-1, -2)).transpose(0, 1)

    def _value(self, scores: Tensor) -> Tensor:
        """What regression says of scores (R,T,q), (R,T,M)."""
        # In double precision, which Apple's GPUs lack: coefficients of 50 and more cancel to weights of at most 1.
        exact = scores.dtype if scores.device.type == "mps" else torch.float64
        given, scores = scores, scores.to(exact)
        centers, linear, coefficients, sharpness, bias = (
            part.to(exact) for part in (self.centers, self.linear, self.coefficients, self.sharpness, self.bias)
        )
        own, other = scores.square().sum(-1, keepdim=True), centers.square().sum(-1)[:, None]
        apart = (own + other - 2 * scores @ centers.transpose(1, 2)).clamp(min=0)
        value = scores @ linear + (-apart * sharpness).exp() @ coefficients + bias
        return value.to(given)

    def _set_rows(self, neutral: Tensor, poses: Tensor, shares: Tensor) -> None:
        """The sums to be taken: the best linear map from the neutral, then principal components in the regions."""
        components = self.centers.shape[2]
        centred = neutral - neutral.mean(0)
        affine = torch.linalg.solve(centred.T @ centred, centred.T)
        turns = nearest_rotation((affine @ poses).float()).double()
        # A row of the turn takes a coordinate of the pose to one of the neutral's.
        aligned = poses @ turns.transpose(1, 2)
        moved = aligned - aligned.mean(1, keepdim=True) - centred
        rows = [affine]
        for share in shares:  # each has axes of its own
            root = (share / share.sum().clamp(min=1e-12)).sqrt()[:, None]
            own = (moved * root).flatten(1)
            axes = _principal_axes(own, components)
            size = (own @ axes.T).square().sum(1).mean().sqrt().clamp(min=_LEAST_MOTION)
            field = (axes.view(components, -1, 3) * root / size).transpose(1, 2)
            field = field - field.mean(2, keepdim=True)
            rows.append(field.reshape(3 * components, -1))
        every = torch.cat(rows)
        self.rows, self.neutral, self.resting = every.float(), neutral.float(), (every @ centred).float()

    def _learn(self, region: int, scores: Tensor, weights: Tensor) -> None:
        """Kernel ridge regression of one region; reach and ridge are those of the least leave-one-out error."""
        squares = torch.cdist(scores, scores).square()
        linear = scores @ scores.T
        mean = weights.mean(0)
        best = float("inf")
        for reach in _REACHES:
            values, vectors = torch.linalg.eigh((-squares / (2 * reach**2)).exp() + linear)
            turned = vectors.T @ (weights - mean)
            for ridge in _RIDGES:
                inverse = 1 / (values.clamp(min=0) + ridge)
                coefficients = vectors @ (inverse[:, None] * turned)
                left_out = coefficients / (vectors.square() @ inverse)[:, None]
                error = float(left_out.square().sum())
                if error < best:
                    best = error
                    self.coefficients[region], self.linear[region] = (
                        coefficients.float(),
                        (scores.T @ coefficients).float(),
                    )
                    self.sharpness[region] = 0.5 / reach**2
        self.centers[region], self.bias[region] = scores.float(), mean.float()


def _principal_axes(rows: Tensor, count: int) -> Tensor:
    """The orthonormal axes (count,n) along which rows (K,n) are longest, zeros where there are no more."""
    values, vectors = largest_eigenpairs(rows @ rows.T, count)
    moving = values > 1e-12 * values[0].clamp(min=1e-30)
    axes = (vectors[:, moving] / values[moving].sqrt()).T @ rows
    return torch.cat([axes, axes.new_zeros(count - len(axes), rows.shape[1])])


class RigWrinkles(nn.Module):
    """Weights of wrinkle maps of a rig's blendshape weights, the same as of the vertices that these make."""

    moved: Tensor
    corrected: Tensor | None

    def __init__(self, wrinkles: WrinkleWeights, rig: BlendshapeRig) -> None:
        super().__init__()
        if len(rig.vertices) != wrinkles.vertex_count:
            raise TopologyError(
                f"rig: found {len(rig.vertices)} vertices, expected the {wrinkles.vertex_count} of the rig that the "
                "weights were learned for"
            )
        apart = float((rig.vertices[wrinkles.sites] - wrinkles.neutral).abs().max())
        if not apart <= _SAME_NEUTRAL:
            raise TopologyError(
                f"rig: found a neutral {apart:.3g} mm from the one that the weights were learned for, expected the same"
            )
        self.wrinkles, self.names, self.activation = wrinkles, rig.names, rig.activation
        self.register_buffer("moved", wrinkles.moments(rig.deltas[:, wrinkles.sites]).flatten(1))
        extra = rig.corrective_deltas
        corrected = None if extra is None else wrinkles.moments(extra[:, wrinkles.sites]).flatten(1)
        self.register_buffer("corrected", corrected)

    @full_precision
    def forward(self, weights: Tensor) -> Tensor:
        """Weights of the maps, (T,R,M), of blendshape weights (T,N)."""
        change = weights @ self.moved
        if self.activation is not None and self.corrected is not None:
            change = change + self.activation(weights) @ self.corrected
        return self.wrinkles.of_moments(change.unflatten(1, (-1, 3)))


def nearest_rotation(matrices: Tensor) -> Tensor:
    """The rotation nearest to each matrix (T,3,3) that is one but for its size and some strain.

    Products of matrices alone, which every runtime has.

    Source: Higham 2008, Functions of Matrices, Newton-Schulz iteration 8.20.
    """
    x = matrices * (3**0.5 / matrices.square().sum((-1, -2), keepdim=True).clamp(min=1e-20).sqrt())
    for _ in range(ROTATION_STEPS):
        x = 1.5 * x - 0.5 * x @ x.transpose(-1, -2) @ x
    return x
