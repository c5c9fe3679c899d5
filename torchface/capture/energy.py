"""Energies of blendshape weights: quadratics that add up and go to ``box_qp``."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.number_checks import LARGEST_WEIGHT, checked_number

# Numbers in the matrices of all markers at once; beyond it frames take their turn.
_MOST_NUMBERS = 2**24
# Numbers in the H of frames that have one each, at once: 8 MB of float64, which stay in a cache.
_CHUNK_NUMBERS = 2**20


@dataclass(frozen=True, eq=False)
class Quadratic:
    r"""An energy :math:`E(w) = \tfrac12 w^\top H w + f^\top w + c` of blendshape weights, a frame each.

    Energies add: ``marker_term(...) + sparsity_term(...)`` is the energy of both. Terms of
    markers are in mm² a marker, terms of video and its priors are negative log likelihoods.
    """

    H: Tensor  # (N,N) for all frames, or (B,N,N)
    f: Tensor  # (B,N), or (1,N) for all frames
    constant: Tensor | None = None  # c, (B,) or (1,); it moves no minimum, it makes energies comparable

    def __post_init__(self) -> None:
        shapes = self.f.ndim == 2 and self.H.ndim in (2, 3) and self.H.shape[-2:] == (self.f.shape[1],) * 2
        batches = (1, self.H.shape[0] if self.H.ndim == 3 else self.f.shape[0])
        # To compare numbers of frames would fix them in a graph.
        if not shapes or (not torch.compiler.is_compiling() and self.f.shape[0] not in batches):
            raise ShapeError(
                f"quadratic: found H {tuple(self.H.shape)} and f {tuple(self.f.shape)}, "
                "expected (N,N) or (B,N,N) and (B,N)"
            )

    def __add__(self, other: "Quadratic") -> "Quadratic":
        if self.H.shape[-1] != other.H.shape[-1]:
            raise ShapeError(f"quadratic: found {self.H.shape[-1]} and {other.H.shape[-1]} weights in a sum")
        constant = other.constant if self.constant is None else self.constant
        if self.constant is not None and other.constant is not None:
            constant = self.constant + other.constant
        return Quadratic(self.H + other.H, self.f + other.f, constant)

    def __mul__(self, factor: float) -> "Quadratic":
        return Quadratic(factor * self.H, factor * self.f, None if self.constant is None else factor * self.constant)

    __rmul__ = __mul__

    def value(self, weights: Tensor) -> Tensor:
        """:math:`E(w)` (B,) at weights (B,N)."""
        bent = weights @ self.H if self.H.ndim == 2 else torch.bmm(self.H, weights[..., None])[..., 0]
        value = (weights * (0.5 * bent + self.f)).sum(-1)
        return value if self.constant is None else value + self.constant


def marker_term(basis: Tensor, rest: Tensor, targets: Tensor) -> Quadratic:
    r"""The mean squared distance of the seen markers to their points on the rig.

    .. math:: E(w) = \frac{1}{|S|} \sum_{m \in S} \lVert b_m + B_m w - t_m \rVert^2

    With every marker of every frame seen, H is one matrix (N,N); otherwise it is (B,N,N).

    Args:
        basis: :math:`B`, the delta of each marker for a unit of each weight, (M,3,N), millimetres.
        rest: :math:`b`, where markers are at rest, (M,3), millimetres.
        targets: :math:`t`, where markers were seen, (B,M,3), millimetres; a NaN coordinate means not seen.

    Returns:
        The term in mm² a marker. A frame without any marker gets a term of zero.

    Source: thesis 4.1.4, equation 33, and appendix, with f's factor 2 and the sign of its targets restored.
    """
    markers, _, shapes = basis.shape
    if basis.ndim != 3 or rest.shape != (markers, 3) or targets.ndim != 3 or targets.shape[1:] != (markers, 3):
        raise ShapeError(
            f"marker_term: found basis {tuple(basis.shape)}, rest {tuple(rest.shape)}, targets "
            f"{tuple(targets.shape)}, expected (M,3,N), (M,3), (B,M,3)"
        )
    traced = torch.compiler.is_compiling()  # a graph has one path, of frames that each have an H
    if not traced:
        check_markers(targets)
    seen = ~torch.isnan(targets).any(-1)
    offset = torch.where(seen[..., None], rest - targets, 0.0)
    rows = basis.flatten(0, 1)
    if not traced and bool(seen.all()):
        H = (2.0 / markers) * (rows.T @ rows)
        return Quadratic(H, (2.0 / markers) * (offset.flatten(1) @ rows), offset.square().sum((-1, -2)) / markers)
    share = seen.to(basis) / seen.sum(-1, keepdim=True).clamp(min=1)
    if traced:
        H = 2.0 * ((rows.T * share.repeat_interleave(3, 1)[:, None]) @ rows)
    elif markers * shapes * shapes <= _MOST_NUMBERS:
        own = (basis.transpose(1, 2) @ basis).flatten(1)
        H = ((2.0 * share) @ own).unflatten(1, (shapes, shapes))
    else:
        H = 2.0 * torch.stack([(rows * one.repeat_interleave(3)[:, None]).T @ rows for one in share])
    weighted = share[..., None] * offset
    return Quadratic(H, 2.0 * (weighted.flatten(1) @ rows), (weighted * offset).sum((-1, -2)))


def check_markers(markers: Tensor) -> None:
    """Raises a ``ValueRangeError`` where a coordinate of markers (B,M,3) is infinite."""
    frames = torch.isinf(markers).flatten(1).any(1).nonzero()[:, 0].tolist()
    if frames:
        raise ValueRangeError(f"markers: infinite in frames {frames[:5]}; expected millimetres, or NaN for not seen")


def sparsity_term(shapes: int, weight: float | Tensor, like: Tensor) -> Quadratic:
    r"""The L1 penalty on every active shape, :math:`E(w) = \beta \sum_i w_i = \beta \lVert w \rVert_1` for w ≥ 0;
    :math:`\beta` is mm² a marker. Source: thesis 4.1.4, equation 33."""
    check_weight("sparsity", weight)
    return Quadratic(like.new_zeros(shapes, shapes), weight * like.new_ones(1, shapes))


def ridge_term(shapes: int, weight: float | Tensor, like: Tensor) -> Quadratic:
    r"""Tikhonov's term, :math:`E(w) = \varepsilon \lVert w \rVert^2`: one minimum, whatever the markers see;
    :math:`\varepsilon` is mm² a marker. Source: thesis 4.1.4, equation 33."""
    check_weight("ridge", weight)
    H = 2 * weight * torch.eye(shapes, dtype=like.dtype, device=like.device)
    return Quadratic(H, like.new_zeros(1, shapes))


def pull_term(targets: Tensor, strength: Tensor) -> Quadratic:
    r"""A pull (B,N), mm² a marker, of each weight toward its own value (B,N), :math:`\sum_i \gamma_i (w_i - \tilde
    w_i)^2`. Source: thesis 4.1.8, equation 38."""
    return Quadratic(torch.diag_embed(2 * strength), -2 * strength * targets, (strength * targets.square()).sum(-1))


def gaussian_term(mean: Tensor, variance: Tensor) -> Quadratic:
    r"""How unlikely weights are under a Gaussian of each, (B,N), but for a constant: :math:`E(w) = \tfrac12 \sum_i
    (w_i - m_i)^2 / V_i`. Source: thesis 4.2.10, equation 65 with its weight 1/V for each shape."""
    return Quadratic(torch.diag_embed(1 / variance), -mean / variance, 0.5 * (mean.square() / variance).sum(1))


def check_weight(name: str, weight: float | Tensor) -> None:
    """Raises a ``ValueRangeError`` where the weight of a term is negative, not finite or too large."""
    # A compiled call checks nothing; a solver of meta tensors waits for its state.
    if torch.compiler.is_compiling() or (isinstance(weight, Tensor) and weight.is_meta):
        return
    checked_number(name, weight, 0.0, LARGEST_WEIGHT)


def chunks_of_frames(rows: Tensor, variables: int) -> tuple[Tensor, ...]:
    """Frames (K,) in chunks whose matrices, of so many variables, are in memory at once."""
    return rows.split(max(1, _CHUNK_NUMBERS // variables**2))
