"""Errors of solved weights, and of a rig's shapes, against the true ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.shape_names import mapping


@dataclass(frozen=True, eq=False)
class WeightError:
    """Solved against true weights.

    Args:
        mean: mean absolute error over frames, a shape, (N,).
        largest: largest absolute error over frames, a shape, (N,).
        correlation: Pearson's, a shape, (N,); NaN for a shape that is constant in either.

    Example:
        >>> error = weight_error(torch.tensor([[0.25], [0.5]]), torch.tensor([[0.25], [1.0]]))
        >>> error.mean.item(), error.largest.item()
        (0.25, 0.5)
    """

    mean: Tensor
    largest: Tensor
    correlation: Tensor


def weight_error(solved: Tensor, true: Tensor) -> WeightError:
    """Compares weights (T,N) with weights (T,N).

    Example:
        >>> true = torch.tensor([[0.0], [0.5], [1.0]])
        >>> weight_error(0.5 * true, true).correlation.round(decimals=4).tolist()
        [1.0]
    """
    if solved.shape != true.shape or solved.ndim != 2:
        raise ShapeError(f"weight_error: found {tuple(solved.shape)} and {tuple(true.shape)}, expected (T,N) twice")
    difference = (solved - true).abs()
    a, b = solved.double() - solved.double().mean(0), true.double() - true.double().mean(0)
    scale = a.norm(dim=0) * b.norm(dim=0)
    correlation = torch.where(scale > 1e-9, (a * b).sum(0) / scale.clamp(min=1e-12), torch.nan)
    return WeightError(difference.mean(0), difference.amax(0), correlation.to(solved.dtype))


def weight_jitter(weights: Tensor) -> float:
    """How much weights (T,N) tremble: the root mean square of their second differences, over that of white noise.

    White noise of deviation 0.01 has a jitter of 0.01; NaN for fewer than three frames.

    Example:
        >>> ramp = torch.linspace(0, 1, 65)[:, None]
        >>> weight_jitter(ramp)
        0.0
        >>> 0.009 < weight_jitter(0.01 * torch.randn(9999, 1, generator=torch.Generator().manual_seed(0))) < 0.011
        True
    """
    if len(weights) < 3:
        return float("nan")
    return float(((weights[2:] - 2 * weights[1:-1] + weights[:-2]).double().square().mean() / 6).sqrt())


@dataclass(frozen=True, eq=False)
class ShapeErrors:
    """Weights by one set of names against weights by another.

    Args:
        names: shapes of the truth that the result has too, N of them.
        error: of each.
        missing: shapes of the truth that the result lacks.
        frames: how many were compared.

    Example:
        >>> curves = torch.linspace(0, 1, 5)[:, None]
        >>> compared = shape_errors(curves, ["jawOpen"], curves.repeat(1, 2), ["jawOpen", "tongueOut"])
        >>> compared.names, compared.missing, compared.frames
        (('jawOpen',), ('tongueOut',), 5)
    """

    names: tuple[str, ...]
    error: WeightError
    missing: tuple[str, ...]
    frames: int


def shape_errors(found: Tensor, found_names: Sequence[str], true: Tensor, true_names: Sequence[str]) -> ShapeErrors:
    """Compares weights (T,N) with true weights (T,M) shape by shape, as :func:`torchface.shape_names.mapping` has it.

    Args:
        found, found_names: what came back; a frame with NaN is left out.
        true, true_names: what was.

    Raises:
        ShapeError: the frames differ in number.
        NameMismatchError: no name of the one means a shape of the other.
        ValueRangeError: there is no frame without NaN.

    Example:
        >>> curves = torch.linspace(0, 1, 5)[:, None]
        >>> shape_errors(curves, ["eyeBlink_L"], curves, ["eyeBlinkLeft"]).error.mean.tolist()
        [0.0]
    """
    if len(found) != len(true):
        raise ShapeError(f"shape_errors: found {len(found)} and {len(true)} frames, expected as many")
    matrix = mapping(found_names, true_names).float()
    compared = matrix.any(1)
    if not compared.any():
        raise NameMismatchError(
            f"shape_errors: found {', '.join(found_names[:5])}, ...; expected some of {', '.join(true_names[:5])}, ..."
        )
    whole = torch.isfinite(found).all(1) & torch.isfinite(true).all(1)
    if not whole.any():
        raise ValueRangeError("shape_errors: found NaN in every frame, expected weights")
    error = weight_error(found[whole].float() @ matrix[compared].T, true[whole].float()[:, compared])
    names = [
        [name for name, has in zip(true_names, compared.tolist(), strict=True) if has is wanted]
        for wanted in (True, False)
    ]
    return ShapeErrors(tuple(names[0]), error, tuple(names[1]), int(whole.sum()))
